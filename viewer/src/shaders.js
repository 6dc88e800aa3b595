import { CLASS_COUNT } from "./colours.js";

export const MAX_SOURCES = 16;

// info: source, residual code (255: no other cloud near), class,
// size in quarter octaves above `spacing`.
export const POINT_VERTEX = `
in vec3 colour;
in vec4 info;
uniform mat4 motion[${MAX_SOURCES}];
uniform vec4 source[${MAX_SOURCES}];   // rgb, shown
uniform vec3 heightRamp[6];
uniform vec3 residualRamp[6];
uniform vec3 classes[${CLASS_COUNT}];
uniform vec4 slab;                     // unit normal, position along it
uniform float slabHalf;                // half its thickness, metres; negative: no slice
uniform int mode;                      // 0 source, 1 height, 2 natural, 3 residual, 4 class
uniform vec2 heights;
uniform float residualMax, spacing, sizeFactor, pixelsPerMetre, isOrtho, minSize, maxSize;
out vec3 tint;

vec3 along(vec3 ramp[6], float share) {
  float at = clamp(share, 0.0, 1.0) * 5.0;
  int low = int(min(floor(at), 4.0));
  return mix(ramp[low], ramp[low + 1], at - float(low));
}

void main() {
  int own = int(info.x + 0.5);
  vec4 world = motion[own] * vec4(position, 1.0);
  bool isCut = slabHalf >= 0.0 && abs(dot(world.xyz, slab.xyz) - slab.w) > slabHalf;
  if (isCut || source[own].a < 0.5) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 0.0;
    return;
  }
  if (mode == 0) tint = source[own].rgb;
  else if (mode == 1) tint = along(heightRamp, (world.z - heights.x) / (heights.y - heights.x));
  else if (mode == 2) tint = colour;
  else if (mode == 3) {
    float share = info.y / 254.0;      // coded as a square root: fine steps where it is small
    tint = info.y > 254.5 ? vec3(0.55) : along(residualRamp, share * share * RESIDUAL_CODE_MAX / residualMax);
  } else tint = classes[min(int(info.z + 0.5), ${CLASS_COUNT - 1})];
  gl_Position = projectionMatrix * viewMatrix * world;
  float perMetre = isOrtho > 0.5 ? pixelsPerMetre : pixelsPerMetre / gl_Position.w;
  gl_PointSize = clamp(spacing * exp2(0.25 * info.w) * perMetre, minSize, maxSize) * sizeFactor;
}`;

export const POINT_FRAGMENT = `
in vec3 tint;
uniform float opacity;
out vec4 result;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  result = vec4(tint, opacity);
}`;

export const SCREEN_VERTEX = `
out vec2 at;
void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }`;

// Eye-dome lighting (Boucheny 2009): a pixel is darker the more its neighbours lie in front of it,
// with depth steps measured in widths of a pixel, so that it looks the same at every distance.
export const EYE_DOME_FRAGMENT = `
in vec2 at;
uniform sampler2D image, depths;
uniform vec2 size;
uniform vec3 ground;
uniform float near, far, isOrtho, pixelAngle, metresPerPixel, strength, ratio;
out vec4 result;

float metres(vec2 where) {
  float z = texture(depths, where).r;
  if (z >= 1.0) return -1.0;
  return isOrtho > 0.5 ? near + z * (far - near) : near * far / (far - z * (far - near));
}

void main() {
  float here = metres(at);
  if (here < 0.0) { result = vec4(ground, 1.0); return; }
  vec3 colour = texture(image, at).rgb;
  float pixel = isOrtho > 0.5 ? metresPerPixel : pixelAngle * here;
  float hidden = 0.0;
  for (int ring = 0; ring < 3; ring++) {
    float reach = ring == 0 ? 1.0 : ring == 1 ? 2.5 : 6.0;
    float weight = ring == 0 ? 0.55 : ring == 1 ? 0.35 : 0.2;
    for (int k = 0; k < 8; k++) {
      float angle = (float(k) + 0.5 * float(ring)) * 0.7853982;
      float there = metres(at + reach * ratio * vec2(cos(angle), sin(angle)) / size);
      if (there < 0.0) continue;
      hidden += weight * clamp((here - there) / (6.0 * reach * ratio * pixel) - 0.1, 0.0, 1.0);
    }
  }
  result = vec4(colour * exp(-0.3 * strength * hidden), 1.0);
}`;

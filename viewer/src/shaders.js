import { CLASS_COUNT, REASON_COUNT } from "./colours.js";

export const MAX_SOURCES = 16;
export const ALONE = 255; // in place of a size: no other point near

// info: source; residual code (255: no other cloud near, 127: zero); class's slot + 16 x reason of removal;
// size in quarter octaves above `spacing`, or ALONE.
export const POINT_VERTEX = `
in vec3 colour;
in vec4 info;
uniform mat4 motion[${MAX_SOURCES}];
uniform vec4 source[${MAX_SOURCES}];   // rgb, shown
uniform vec3 heightRamp[6];
uniform vec3 residualRamp[6];
uniform vec3 classes[${CLASS_COUNT}];
uniform vec3 reasons[${REASON_COUNT}];
uniform vec4 slab;                     // unit normal, position along it
uniform float slabHalf;                // half its thickness, metres; negative: no slice
uniform vec4 box[3];                   // unit axes of the cut box, middle along each
uniform vec3 boxHalf;                  // half its edges, metres; negative: no box
uniform int mode;                      // 0 source, 1 height, 2 natural, 3 residual, 4 class, 5 reason
uniform float showRemoved;
uniform vec2 heights;
uniform float thinned; // how many times farther apart the points drawn now lie
uniform float residualMax, isSigned, spacing, sizeFactor, pixelsPerMetre, isOrtho, minSize, maxSize;
out vec3 tint;
out float bulge;                       // metres: how much farther a dot's rim lies than its middle

vec3 along(vec3 ramp[6], float share) {
  float at = clamp(share, 0.0, 1.0) * 5.0;
  int low = int(min(floor(at), 4.0));
  return mix(ramp[low], ramp[low + 1], at - float(low));
}

bool isOut(vec3 world) {
  if (slabHalf >= 0.0 && abs(dot(world, slab.xyz) - slab.w) > slabHalf) return true;
  if (boxHalf.x < 0.0) return false;
  vec3 off = vec3(dot(world, box[0].xyz) - box[0].w, dot(world, box[1].xyz) - box[1].w,
                  dot(world, box[2].xyz) - box[2].w);
  return any(greaterThan(abs(off), boxHalf));
}

void main() {
  int own = int(info.x + 0.5);
  int packed = int(info.z + 0.5);
  int reason = packed / ${CLASS_COUNT};
  vec4 world = motion[own] * vec4(position, 1.0);
  if (isOut(world.xyz) || source[own].a < 0.5 || (reason > 0 && showRemoved < 0.5)) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 0.0;
    return;
  }
  if (mode == 0) tint = source[own].rgb;
  else if (mode == 1) tint = along(heightRamp, (world.z - heights.x) / (heights.y - heights.x));
  else if (mode == 2) tint = colour;
  else if (mode == 3) {
    float root = (info.y - 127.0) / 127.0; // coded as a square root: fine steps where it is small
    float value = sign(root) * root * root * RESIDUAL_CODE_MAX / residualMax;
    float share = isSigned > 0.5 ? 0.5 + 0.5 * value : abs(value);
    tint = info.y > 254.5 ? vec3(0.55) : along(residualRamp, share);
  } else if (mode == 4) tint = classes[packed - ${CLASS_COUNT} * reason];
  else tint = reasons[reason];
  gl_Position = projectionMatrix * viewMatrix * world;
  float perMetre = isOrtho > 0.5 ? pixelsPerMetre : pixelsPerMetre / gl_Position.w;
  float size = clamp(spacing * thinned * exp2(0.25 * info.w) * perMetre, minSize, maxSize) * sizeFactor;
  // What was taken out is scattered: its spacing says nothing, so it is drawn as dots of one size.
  if (info.w > 254.5) size = 1.5 * minSize * sizeFactor;
  gl_PointSize = reason > 0 ? 2.4 * minSize * sizeFactor : size;
  bulge = 0.25 * gl_PointSize / perMetre;
}`;

export const POINT_FRAGMENT = `
in vec3 tint;
in float bulge;
uniform float opacity, isOrtho, near, far;
out vec4 result;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  float share = 4.0 * dot(off, off);
  if (share > 1.0) discard;
  result = vec4(tint, opacity);
  // Dots are bowls seen from above: neighbours meet between them instead of covering each other.
  float back = share * bulge;
  if (isOrtho > 0.5) gl_FragDepth = gl_FragCoord.z + back / (far - near);
  else {
    float here = near * far / (far - gl_FragCoord.z * (far - near)) + back;
    gl_FragDepth = (far - near * far / here) / (far - near);
  }
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

// What is drawn: points, cameras, lighting. Draws only when something has changed.
import {
  BufferAttribute, BufferGeometry, Color, DepthTexture, GLSL3, Mesh, Matrix4, NearestFilter,
  OrthographicCamera, PerspectiveCamera, PlaneGeometry, Points, Quaternion, Scene, ShaderMaterial,
  UnsignedIntType, Vector2, Vector3, Vector4, WebGLRenderer, WebGLRenderTarget,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { HEIGHT, RESIDUAL, classColours } from "./colours.js";
import {
  EYE_DOME_FRAGMENT, MAX_SOURCES, POINT_FRAGMENT, POINT_VERTEX, SCREEN_VERTEX,
} from "./shaders.js";

const FIELD_OF_VIEW = 45;
const HALF = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
const MAX_RATIO = 2;

const colourOf = (text) => new Color().setStyle(text, "srgb-linear"); // no conversion: drawn as said

export class Stage {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.scene = scene;
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = "srgb-linear";
    this.renderer.autoClear = false;
    this.world = new Scene();
    this.chunks = new Set();
    this.materials = new Map();
    this.onDraw = new Set();
    this.lighting = true;
    this.makeUniforms();
    this.makeCameras();
    this.makeLighting();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    const loop = () => {
      requestAnimationFrame(loop);
      if (this.animation) this.animation();
      if (this.isStale) this.draw();
    };
    requestAnimationFrame(loop);
  }

  makeUniforms() {
    const { sources, floor, top, residual } = this.scene;
    const shown = Array.from({ length: MAX_SOURCES }, (_, index) => {
      const [r, g, b] = sources[Math.min(index, sources.length - 1)].colour;
      return new Vector4(r / 255, g / 255, b / 255, 1);
    });
    this.uniforms = {
      motion: { value: Array.from({ length: MAX_SOURCES }, () => new Matrix4()) },
      source: { value: shown },
      heightRamp: { value: HEIGHT.map(colourOf) },
      residualRamp: { value: RESIDUAL.map(colourOf) },
      classes: { value: classColours().map(colourOf) },
      slab: { value: new Vector4(0, 0, 1, 0) },
      slabHalf: { value: -1 },
      mode: { value: 0 },
      heights: { value: new Vector2(floor, Math.max(top, floor + 0.01)) },
      residualMax: { value: residual?.shown_m ?? 0.05 },
      sizeFactor: { value: 1 },
      pixelsPerMetre: { value: 1 },
      isOrtho: { value: 0 },
      minSize: { value: 1.5 },
      maxSize: { value: 14 },
      opacity: { value: 1 },
    };
    this.motions = sources.map((source) => motionOf(source, this.scene.centre));
    this.progress = 1;
  }

  makeCameras() {
    this.perspective = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 1000);
    this.orthographic = new OrthographicCamera(-1, 1, 1, -1, 0.1, 1000);
    for (const camera of [this.perspective, this.orthographic]) camera.up.set(0, 0, 1);
    this.camera = this.perspective;
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.invalidate());
    this.controls.listenToKeyEvents(this.canvas);
  }

  makeLighting() {
    const uniforms = {
      image: { value: null }, depths: { value: null }, size: { value: new Vector2() },
      ground: { value: new Color() }, near: { value: 1 }, far: { value: 2 }, isOrtho: { value: 0 },
      pixelAngle: { value: 1 }, metresPerPixel: { value: 1 }, strength: { value: 1 },
      ratio: { value: 1 },
    };
    const material = new ShaderMaterial({
      glslVersion: GLSL3, vertexShader: SCREEN_VERTEX, fragmentShader: EYE_DOME_FRAGMENT, uniforms,
      depthTest: false, depthWrite: false,
    });
    const quad = new Mesh(new PlaneGeometry(2, 2), material);
    quad.frustumCulled = false;
    this.screen = new Scene();
    this.screen.add(quad);
    this.screenUniforms = uniforms;
    this.screenCamera = new OrthographicCamera(-1, 1, 1, -1, 0, 1);
  }

  setGround(text) {
    this.screenUniforms.ground.value.setStyle(text, "srgb-linear");
    this.invalidate();
  }

  // position: Float32Array (3n), metres about the scene's origin; colour: Uint8Array (3n);
  // info: Uint8Array (4n), see shaders. Returns the chunk, to be given to `remove`.
  add({ position, colour, info, spacing }) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(position, 3));
    geometry.setAttribute("colour", new BufferAttribute(colour, 3, true));
    geometry.setAttribute("info", new BufferAttribute(info, 4, false));
    const points = new Points(geometry, this.materialFor(spacing));
    points.frustumCulled = false;
    points.userData = { position, info };
    this.world.add(points);
    this.chunks.add(points);
    this.invalidate();
    return points;
  }

  setSpacing(points, spacing) {
    points.material = this.materialFor(spacing);
  }

  remove(points) {
    this.world.remove(points);
    this.chunks.delete(points);
    points.geometry.dispose();
    this.invalidate();
  }

  materialFor(spacing) {
    const key = spacing.toPrecision(3);
    if (!this.materials.has(key)) {
      const code = (this.scene.residual?.code_max_m ?? 1).toFixed(6);
      const material = new ShaderMaterial({
        glslVersion: GLSL3, vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT,
        defines: { RESIDUAL_CODE_MAX: code },
        uniforms: { ...this.uniforms, spacing: { value: Number(key) } },
      });
      this.materials.set(key, material);
      this.applySliceStyle(material);
    }
    return this.materials.get(key);
  }

  // A slice is a drawing, not a surface: see-through dots, so that both colours show where they meet.
  applySliceStyle(material) {
    const isSlice = this.uniforms.slabHalf.value >= 0;
    material.transparent = isSlice;
    material.depthTest = !isSlice;
    material.depthWrite = !isSlice;
  }

  setSlab(normal, position, half) {
    this.uniforms.slab.value.set(...normal, position);
    this.uniforms.slabHalf.value = half;
    this.uniforms.opacity.value = half >= 0 ? 0.6 : 1;
    for (const material of this.materials.values()) this.applySliceStyle(material);
    this.invalidate();
  }

  // 0: as delivered, 1: registered.
  setProgress(progress) {
    this.progress = progress;
    this.motions.forEach((motion, index) => motion(1 - progress, this.uniforms.motion.value[index]));
    this.invalidate();
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_RATIO);
    const width = Math.max(1, this.canvas.clientWidth), height = Math.max(1, this.canvas.clientHeight);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    const across = Math.floor(width * ratio), down = Math.floor(height * ratio);
    this.target?.depthTexture.dispose();
    this.target?.dispose();
    this.target = new WebGLRenderTarget(across, down, {
      minFilter: NearestFilter, magFilter: NearestFilter,
      depthTexture: new DepthTexture(across, down, UnsignedIntType),
    });
    this.screenUniforms.image.value = this.target.texture;
    this.screenUniforms.depths.value = this.target.depthTexture;
    this.screenUniforms.size.value.set(across, down);
    this.screenUniforms.ratio.value = ratio;
    this.ratio = ratio;
    this.invalidate();
  }

  get aspect() {
    return this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
  }

  get isOrtho() {
    return this.camera === this.orthographic;
  }

  // Metres from the middle of the picture to its upper edge, at the target.
  get halfHeight() {
    if (this.isOrtho) return this.orthographic.top / this.orthographic.zoom;
    return this.camera.position.distanceTo(this.controls.target) * HALF;
  }

  // direction: from the target to the eye; halfHeight: what the picture shows, metres.
  look(target, direction, halfHeight, isOrtho) {
    const distance = halfHeight / HALF;
    this.camera = isOrtho ? this.orthographic : this.perspective;
    this.controls.object = this.camera;
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(direction, distance);
    this.orthographic.top = halfHeight;
    this.orthographic.zoom = 1;
    this.controls.update();
    this.invalidate();
  }

  setOrtho(isOrtho) {
    const target = this.controls.target.clone();
    const direction = this.camera.position.clone().sub(target).normalize();
    this.look(target, direction, this.halfHeight, isOrtho);
  }

  prepareCamera() {
    const reach = this.scene.reach;
    const centre = new Vector3(...this.scene.centre);
    const camera = this.camera;
    camera.updateMatrixWorld();
    const distance = camera.position.distanceTo(centre);
    if (this.isOrtho) {
      const half = camera.top;
      camera.bottom = -half;
      camera.right = half * this.aspect;
      camera.left = -camera.right;
      camera.near = distance - 3 * reach;
      camera.far = distance + 3 * reach;
    } else {
      camera.aspect = this.aspect;
      camera.far = distance + 3 * reach;
      camera.near = Math.max(camera.far / 2e4, 0.002 * reach, distance - 3 * reach);
    }
    camera.updateProjectionMatrix();
    const pixels = this.canvas.clientHeight * this.ratio;
    const u = this.uniforms, s = this.screenUniforms;
    u.isOrtho.value = s.isOrtho.value = this.isOrtho ? 1 : 0;
    u.pixelsPerMetre.value = this.isOrtho ? pixels / (2 * this.halfHeight) : pixels / (2 * HALF);
    const isSlice = u.slabHalf.value >= 0;
    u.minSize.value = (isSlice ? 3 : 1.5) * this.ratio;
    u.maxSize.value = (isSlice ? 4 : 14) * this.ratio;
    s.near.value = camera.near;
    s.far.value = camera.far;
    s.pixelAngle.value = (2 * HALF) / pixels;
    s.metresPerPixel.value = (2 * this.halfHeight) / pixels;
    s.strength.value = isSlice || !this.lighting ? 0 : 1;
  }

  draw() {
    this.isStale = false;
    this.prepareCamera();
    const { ground } = this.screenUniforms;
    const isSlice = this.uniforms.slabHalf.value >= 0;
    this.renderer.setClearColor(ground.value, 1);
    // A slice writes no depth, so it is drawn straight onto the screen.
    this.renderer.setRenderTarget(isSlice ? null : this.target);
    this.renderer.clear();
    this.renderer.render(this.world, this.camera);
    if (!isSlice) {
      this.renderer.setRenderTarget(null);
      this.renderer.render(this.screen, this.screenCamera);
    }
    for (const listener of this.onDraw) listener();
  }

  invalidate() {
    this.isStale = true;
  }

  // Local metres to CSS pixels of the canvas; z in -1..1 where it is in front of the camera.
  project(point) {
    this.camera.updateMatrixWorld();
    const at = new Vector3(...point).project(this.camera);
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight, at.z];
  }

  // The point under a place of the canvas (CSS pixels): of those near the place, the one in front.
  pick(x, y, reachPixels = 7) {
    this.camera.updateMatrixWorld();
    const view = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const { slab, slabHalf, source, motion } = this.uniforms;
    const half = slabHalf.value, cut = slab.value;
    const eye = this.camera.position, ahead = this.camera.getWorldDirection(new Vector3());
    let best = null, bestScore = Infinity;
    for (const chunk of this.chunks) {
      if (!chunk.visible) continue;
      const { position, info } = chunk.userData;
      for (let i = 0; i < position.length; i += 3) {
        const own = info[(4 * i) / 3];
        if (source.value[own].w < 0.5) continue;
        const m = motion.value[own].elements, e = view.elements;
        const a = position[i], b = position[i + 1], c = position[i + 2];
        const px = m[0] * a + m[4] * b + m[8] * c + m[12];
        const py = m[1] * a + m[5] * b + m[9] * c + m[13];
        const pz = m[2] * a + m[6] * b + m[10] * c + m[14];
        if (half >= 0 && Math.abs(px * cut.x + py * cut.y + pz * cut.z - cut.w) > half) continue;
        const w = e[3] * px + e[7] * py + e[11] * pz + e[15];
        if (w <= 0) continue;
        const sx = ((e[0] * px + e[4] * py + e[8] * pz + e[12]) / w + 1) * 0.5 * width - x;
        const sy = (1 - (e[1] * px + e[5] * py + e[9] * pz + e[13]) / w) * 0.5 * height - y;
        const off = Math.hypot(sx, sy);
        if (off > reachPixels) continue;
        // A step towards the eye counts for a third of a step sideways on the picture.
        const depth = (px - eye.x) * ahead.x + (py - eye.y) * ahead.y + (pz - eye.z) * ahead.z;
        const pixel = this.isOrtho ? (2 * this.halfHeight) / height : (2 * HALF * w) / height;
        const score = half >= 0 ? off : off + (0.35 * depth) / pixel;
        if (score < bestScore) {
          bestScore = score;
          best = { point: [px, py, pz], source: own, off };
        }
      }
    }
    return best;
  }
}

// Returns (share, matrix): fills the matrix that shows a cloud `share` of the way from where it was
// registered (0) back to where it was delivered (1), turning about the cloud's own middle.
function motionOf(source, fallback) {
  if (!source.motion) return (_, matrix) => matrix.identity();
  const back = new Matrix4().set(...source.motion);
  const centre = new Vector3(...(source.centre ?? fallback));
  const shift = centre.clone().applyMatrix4(back).sub(centre);
  const turn = new Quaternion(), size = new Vector3(), still = new Quaternion();
  back.decompose(new Vector3(), turn, size);
  const rotation = new Quaternion(), at = new Vector3();
  return (share, matrix) => {
    rotation.slerpQuaternions(still, turn, share);
    const scale = 1 + (size.x - 1) * share;
    matrix.compose(at.set(0, 0, 0), rotation, new Vector3(scale, scale, scale));
    at.copy(centre).applyMatrix4(matrix).negate().add(centre).addScaledVector(shift, share);
    return matrix.setPosition(at);
  };
}

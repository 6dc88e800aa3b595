// What is drawn: points, cameras, lighting. Draws only when something has changed.
import {
  BufferAttribute, BufferGeometry, Color, DepthTexture, GLSL3, Mesh, Matrix4, NearestFilter,
  OrthographicCamera, PerspectiveCamera, PlaneGeometry, Points, Scene, ShaderMaterial,
  UnsignedIntType, Vector2, Vector3, Vector4, WebGLRenderer, WebGLRenderTarget,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { HEIGHT, RESIDUAL, SIGNED, classColours, reasonColours } from "./colours.js";
import { motionOf } from "./motion.js";
import { Pace, interleaved } from "./pace.js";
import { pick } from "./pick.js";
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
    this.pace = new Pace(this);
    const loop = (now) => {
      if (this.isDisposed) return;
      requestAnimationFrame(loop);
      if (this.animation) this.animation();
      this.pace.tick(now, this.isStale);
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
      residualRamp: { value: (residual?.is_signed ? SIGNED : RESIDUAL).map(colourOf) },
      classes: { value: classColours().map(colourOf) },
      reasons: { value: reasonColours().map(colourOf) },
      box: { value: [0, 1, 2].map(() => new Vector4()) },
      boxHalf: { value: new Vector3(-1, -1, -1) },
      showRemoved: { value: 0 },
      isSigned: { value: residual?.is_signed ? 1 : 0 },
      slab: { value: new Vector4(0, 0, 1, 0) },
      slabHalf: { value: -1 },
      mode: { value: 0 },
      heights: { value: new Vector2(floor, Math.max(top, floor + 0.01)) },
      residualMax: { value: residual?.shown_m ?? 0.05 },
      sizeFactor: { value: 1 },
      pixelsPerMetre: { value: 1 },
      isOrtho: { value: 0 },
      minSize: { value: 1.5 },
      maxSize: { value: 22 },
      opacity: { value: 1 },
      thinned: { value: 1 },
      near: { value: 1 },
      far: { value: 2 },
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
    this.controls.addEventListener("start", () => this.pace.begin());
    this.controls.addEventListener("end", () => this.pace.end());
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
  add(points_) {
    const { position, colour, info, spacing } = interleaved(points_);
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
    // In eighths of an octave: chunks share materials.
    const key = (2 ** (Math.round(8 * Math.log2(spacing)) / 8)).toPrecision(6);
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

  // axes: three unit vectors; low, high: metres along them, about `origin`. Null: no box.
  setBox(axes, origin, low, high) {
    if (!axes) {
      this.uniforms.boxHalf.value.set(-1, -1, -1);
    } else {
      axes.forEach((axis, k) => {
        const middle = axis.reduce((sum, value, i) => sum + value * origin[i], 0) + (low[k] + high[k]) / 2;
        this.uniforms.box.value[k].set(...axis, middle);
      });
      this.uniforms.boxHalf.value.set(...high.map((value, k) => (value - low[k]) / 2));
    }
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
    return Math.max(1, this.canvas.clientWidth) / Math.max(1, this.canvas.clientHeight);
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
    u.maxSize.value = (isSlice ? 4 : 22) * this.ratio;
    u.near.value = s.near.value = camera.near;
    u.far.value = s.far.value = camera.far;
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

  // Gives the graphics memory back; the stage draws no more.
  dispose() {
    this.isDisposed = true;
    for (const chunk of [...this.chunks]) this.remove(chunk);
    this.controls.dispose();
    this.target.depthTexture.dispose();
    this.target.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  invalidate() {
    this.isStale = true;
  }

  // The camera as the next picture will have it.
  ready() {
    if (this.isStale) this.prepareCamera();
    else this.camera.updateMatrixWorld();
  }

  // Local metres to CSS pixels of the canvas; z in -1..1 where it is in front of the camera.
  project(point) {
    this.ready();
    const at = new Vector3(...point).project(this.camera);
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight, at.z];
  }

  // Where the line of sight through a place of the canvas meets the level z (local metres).
  onPlane([x, y], z) {
    this.ready();
    const ends = [-1, 1].map((depth) => new Vector3(
      (2 * x) / this.canvas.clientWidth - 1, 1 - (2 * y) / this.canvas.clientHeight, depth).unproject(this.camera));
    const along = ends[1].clone().sub(ends[0]);
    const share = Math.abs(along.z) < 1e-9 ? 0 : (z - ends[0].z) / along.z;
    return ends[0].addScaledVector(along, share).toArray();
  }

  pick(x, y, reachPixels) {
    return pick(this, x, y, reachPixels);
  }

  // Calls visit(x, y, z, source) for about `most` of the points that are drawn, evenly.
  sample(most, visit) {
    const shown = [...this.chunks].filter((chunk) => chunk.visible);
    const total = shown.reduce((sum, chunk) => sum + chunk.userData.position.length / 3, 0);
    const stride = Math.max(1, Math.floor(total / most));
    for (const { userData: { position, info } } of shown) {
      for (let k = 0; k < info.length / 4; k += stride) {
        const at = this.shownAt(position, info, k);
        if (at) visit(...at, info[4 * k]);
      }
    }
  }

  // Where point k of a chunk is drawn (local metres), null where it is not.
  shownAt(position, info, k) {
    const u = this.uniforms, own = info[4 * k];
    if (u.source.value[own].w < 0.5 || (info[4 * k + 2] > 31 && u.showRemoved.value < 0.5)) return null;
    const m = u.motion.value[own].elements;
    const a = position[3 * k], b = position[3 * k + 1], c = position[3 * k + 2];
    const x = m[0] * a + m[4] * b + m[8] * c + m[12];
    const y = m[1] * a + m[5] * b + m[9] * c + m[13];
    const z = m[2] * a + m[6] * b + m[10] * c + m[14];
    const { x: nx, y: ny, z: nz, w: at } = u.slab.value;
    if (u.slabHalf.value >= 0 && Math.abs(x * nx + y * ny + z * nz - at) > u.slabHalf.value) return null;
    const half = u.boxHalf.value;
    if (half.x >= 0) {
      const halves = [half.x, half.y, half.z];
      for (let axis = 0; axis < 3; axis++) {
        const e = u.box.value[axis];
        if (Math.abs(x * e.x + y * e.y + z * e.z - e.w) > halves[axis]) return null;
      }
    }
    return [x, y, z];
  }
}

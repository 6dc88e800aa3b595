// What can be set, and what each setting does to the stage. Knows nothing of buttons.
import { Vector3 } from "three";

export const COLOURS = ["source", "height", "natural", "residual", "class", "reason"];
export const VIEWS = ["iso", "plan", "front", "right", "back", "left"];
export const SLICES = ["off", "level", "along", "across", "drawn"];
export const THICKNESSES = [0.02, 0.05, 0.1, 0.2, 0.5, 1];
const SECONDS = 1.4;
const SNAP = Math.cos((5 * Math.PI) / 180);
const THINNEST_BOX = 0.05;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class State extends EventTarget {
  constructor(stage) {
    super();
    this.stage = stage;
    this.scene = stage.scene;
    const { along, across } = axesOf(this.scene.yaw_deg);
    this.axes = { along, across, up: [0, 0, 1] };
    stage.controls.addEventListener("end", () => this.snap());
    this.reset();
  }

  changed() {
    this.stage.invalidate();
    this.dispatchEvent(new Event("change"));
  }

  reset() {
    this.stage.animation = null;
    this.size = 1;
    this.thickness = this.scene.thickness_m ?? 0.1;
    this.position = { level: this.scene.level ?? 0.4, along: 0.5, across: 0.5, drawn: 0.5 };
    this.line = null;
    this.shown = this.scene.sources.map(() => true);
    this.stage.lighting = true;
    this.stage.uniforms.sizeFactor.value = 1;
    this.slice = "off";
    this.applySlice();
    this.box = this.wholeBox();
    this.isBoxed = false;
    this.applyBox();
    this.applyShown();
    this.setColour(this.colours[0]);
    this.stage.setProgress(1);
    this.isRegistered = true;
    this.setView("iso");
  }

  get colours() {
    return this.scene.colours;
  }

  get hasMotion() {
    return this.scene.sources.some((source) => source.motion);
  }

  setColour(name) {
    this.colour = name;
    this.stage.uniforms.mode.value = COLOURS.indexOf(name);
    // What was taken out is no part of the result: it is shown only where the reason is asked for.
    this.stage.uniforms.showRemoved.value = name === "reason" ? 1 : 0;
    this.changed();
  }

  // Which way the eye looks from, for a view of VIEWS.
  directionOf(name) {
    const { along, across } = this.axes;
    if (name === "iso") {
      const a = ((this.scene.yaw_deg + 305) * Math.PI) / 180, e = (28 * Math.PI) / 180;
      return new Vector3(Math.cos(a) * Math.cos(e), Math.sin(a) * Math.cos(e), Math.sin(e));
    }
    // A hair off the vertical: it says which way is up on the picture.
    if (name === "plan") return new Vector3(...across).multiplyScalar(-1e-4).add(new Vector3(0, 0, 1)).normalize();
    const sides = { front: [across, -1], back: [across, 1], right: [along, 1], left: [along, -1] };
    const [axis, sign] = sides[name];
    return new Vector3(...axis).multiplyScalar(sign);
  }

  setView(name) {
    this.view = name;
    const { centre, radius, floor, top } = this.scene;
    const target = new Vector3(...centre);
    const aspect = this.stage.aspect, tall = top - floor;
    const half = {
      iso: Math.max((radius * 0.9) / aspect, radius * 0.45 + tall * 0.4),
      plan: (radius * 1.03) / Math.min(1, aspect),
    }[name] ?? Math.max(tall * 0.7, (radius * 1.03) / aspect);
    this.stage.look(target, this.directionOf(name), half, name !== "iso");
    this.changed();
  }

  // Brings what is shown (in its slice and box) into the picture, seen from where the eye is.
  fit() {
    const { stage } = this;
    const { camera, controls } = stage;
    const eye = camera.position.clone().sub(controls.target).normalize();
    const right = new Vector3().setFromMatrixColumn(camera.matrixWorld, 0);
    const up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    const seen = [[], [], []];
    stage.sample(60_000, (x, y, z) => {
      [right, up, eye].forEach((axis, k) => seen[k].push(axis.x * x + axis.y * y + axis.z * z));
    });
    if (seen[0].length === 0) return;
    const ends = seen.map((values) => {
      const sorted = Float64Array.from(values).sort();
      return [sorted[Math.floor(0.005 * sorted.length)], sorted[Math.ceil(0.995 * (sorted.length - 1))]];
    });
    const middle = ends.map(([low, high]) => (low + high) / 2);
    const [wide, high] = ends.map(([low, top]) => (top - low) / 2);
    const target = new Vector3()
      .addScaledVector(right, middle[0]).addScaledVector(up, middle[1]).addScaledVector(eye, middle[2]);
    // In perspective what is near looks larger: some room for it.
    const room = stage.isOrtho ? 1.06 : 1.25;
    stage.look(target, eye, room * Math.max(high, wide / stage.aspect, 0.05), stage.isOrtho);
    this.changed();
  }

  // A parallel view that was turned to within five degrees of a side is that side.
  snap() {
    if (!this.stage.isOrtho) return;
    const { camera, controls } = this.stage;
    const eye = camera.position.clone().sub(controls.target).normalize();
    const name = VIEWS.slice(1).find((view) => this.directionOf(view).dot(eye) > SNAP);
    if (!name || this.directionOf(name).dot(eye) > 1 - 1e-9) return;
    // In plan the picture may be turned about the vertical: then it is left as it is.
    const up = new Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    if (name === "plan" && up.dot(new Vector3(...this.axes.across)) < SNAP) return;
    this.view = name;
    this.stage.look(controls.target.clone(), this.directionOf(name), this.stage.halfHeight, true);
    this.changed();
  }

  setShown(index, isShown) {
    this.shown[index] = isShown;
    this.applyShown();
    this.changed();
  }

  applyShown() {
    this.stage.uniforms.source.value.forEach((vector, index) => {
      vector.w = this.shown[Math.min(index, this.shown.length - 1)] ? 1 : 0;
    });
  }

  setSize(size) {
    this.size = Math.min(4, Math.max(0.25, size));
    this.stage.uniforms.sizeFactor.value = this.size;
    this.changed();
  }

  setLighting(isOn) {
    this.stage.lighting = isOn;
    this.changed();
  }

  // Moves the clouds between where they were delivered and where they were registered.
  setRegistered(isRegistered, isAnimated = true) {
    this.isRegistered = isRegistered;
    const goal = isRegistered ? 1 : 0;
    if (!isAnimated || matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.stage.animation = null;
      this.stage.setProgress(goal);
    } else {
      const from = this.stage.progress, start = performance.now();
      this.stage.animation = () => {
        const share = Math.min(1, (performance.now() - start) / (1000 * SECONDS));
        const eased = share * share * (3 - 2 * share);
        this.stage.setProgress(from + (goal - from) * eased);
        if (share >= 1) this.stage.animation = null;
      };
    }
    this.changed();
  }

  setSlice(name) {
    if (name === "drawn" && !this.line) return;
    const before = this.slice;
    this.slice = name;
    this.applySlice();
    if (name === "off" && before !== "off") this.setView("iso");
    if (name !== "off" && name !== before) {
      // Where the clouds agree is seen by whose points are whose.
      if (before === "off" && this.scene.sources.length > 1) this.setColour("source");
      if (name === "drawn") this.faceSlice();
      else this.setView({ level: "plan", along: "front", across: "right" }[name]);
    }
    this.changed();
  }

  // An upright section through two places in plan, seen from the right-hand side of a -> b.
  drawSlice(a, b) {
    this.line = { a, b };
    this.position.drawn = 0.5;
    this.slice = "off";
    this.setSlice("drawn");
  }

  faceSlice() {
    const { a, b } = this.line;
    const middle = new Vector3((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, this.scene.centre[2]);
    const half = Math.max((this.scene.top - this.scene.floor) * 0.7,
      (0.6 * Math.hypot(b[0] - a[0], b[1] - a[1])) / this.stage.aspect);
    this.view = "section";
    this.stage.look(middle, new Vector3(...this.slab.normal), half, true);
  }

  // The slice as a plane: unit normal, where its range has its zero along it, the range.
  get slab() {
    const { floor, top, radius, centre } = this.scene;
    if (this.slice === "level") return { normal: this.axes.up, zero: 0, range: [floor, top] };
    if (this.slice === "drawn") {
      const { a, b } = this.line;
      const long = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
      const normal = [(b[1] - a[1]) / long, (a[0] - b[0]) / long, 0];
      return { normal, zero: normal[0] * a[0] + normal[1] * a[1], range: [-radius, radius] };
    }
    const normal = this.slice === "along" ? this.axes.across : this.axes.along;
    return { normal, zero: dot(normal, [centre[0], centre[1], 0]), range: [-radius, radius] };
  }

  // share: 0..1 of the way through the building.
  setPosition(share) {
    this.position[this.slice] = Math.min(1, Math.max(0, share));
    this.applySlice();
    this.changed();
  }

  moveSlice(metres) {
    const [low, high] = this.slab.range;
    this.setPosition(this.position[this.slice] + metres / (high - low));
  }

  setThickness(thickness) {
    this.thickness = thickness;
    this.applySlice();
    this.changed();
  }

  get positionMetres() {
    const [low, high] = this.slab.range;
    return low + (high - low) * this.position[this.slice];
  }

  applySlice() {
    if (this.slice === "off") {
      this.stage.setSlab([0, 0, 1], 0, -1);
      return;
    }
    const { normal, zero } = this.slab;
    this.stage.setSlab(normal, zero + this.positionMetres, this.thickness / 2);
  }

  get where() {
    const at = this.positionMetres;
    if (this.slice === "level") return `${(at - this.scene.floor).toFixed(2)} m above the ground`;
    const from = this.slice === "drawn" ? "the line" : "the middle";
    return `${at >= 0 ? "+" : "−"}${Math.abs(at).toFixed(2)} m from ${from}`;
  }

  // The cut box: metres along (along, across, up) about the scene's centre.
  get boxAxes() {
    return [this.axes.along, this.axes.across, this.axes.up];
  }

  wholeBox() {
    const { radius, floor, top, centre } = this.scene;
    const side = radius * 0.7;
    return { low: [-side, -side, floor - 0.3 - centre[2]], high: [side, side, top + 0.3 - centre[2]] };
  }

  setBoxed(isBoxed) {
    this.isBoxed = isBoxed;
    this.applyBox();
    this.changed();
  }

  // Moves one side of the box: axis 0..2, side "low" or "high"; it never turns inside out.
  setBoxSide(axis, side, value) {
    const { low, high } = this.box;
    if (side === "low") low[axis] = Math.min(value, high[axis] - THINNEST_BOX);
    else high[axis] = Math.max(value, low[axis] + THINNEST_BOX);
    this.applyBox();
    this.changed();
  }

  resetBox() {
    this.box = this.wholeBox();
    this.applyBox();
    this.changed();
  }

  applyBox() {
    if (this.isBoxed) this.stage.setBox(this.boxAxes, this.scene.centre, this.box.low, this.box.high);
    else this.stage.setBox(null);
  }
}

function axesOf(yaw) {
  const c = Math.cos((yaw * Math.PI) / 180), s = Math.sin((yaw * Math.PI) / 180);
  return { along: [c, s, 0], across: [-s, c, 0] };
}

// What can be set, and what each setting does to the stage. Knows nothing of buttons.
import { Vector3 } from "three";

export const COLOURS = ["source", "height", "natural", "residual", "class"];
export const VIEWS = ["iso", "plan", "front", "side"];
export const SLICES = ["off", "level", "along", "across"];
export const THICKNESSES = [0.02, 0.05, 0.1, 0.2, 0.5, 1];
const SECONDS = 1.4;

export class State extends EventTarget {
  constructor(stage) {
    super();
    this.stage = stage;
    this.scene = stage.scene;
    const { along, across } = axesOf(this.scene.yaw_deg);
    this.axes = { along, across, up: [0, 0, 1] };
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
    this.position = { level: this.scene.level ?? 0.4, along: 0.5, across: 0.5 };
    this.shown = this.scene.sources.map(() => true);
    this.stage.lighting = true;
    this.stage.uniforms.sizeFactor.value = 1;
    this.slice = "off";
    this.applySlice();
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
    this.changed();
  }

  setView(name) {
    this.view = name;
    const { centre, radius, floor, top, yaw_deg: yaw } = this.scene;
    const { along, across } = this.axes;
    const target = new Vector3(...centre);
    const aspect = this.stage.aspect, tall = top - floor;
    const inPlan = (radius * 1.03) / Math.min(1, aspect);
    const upright = Math.max(tall * 0.7, (radius * 1.03) / aspect);
    if (name === "iso") {
      const a = ((yaw + 305) * Math.PI) / 180, e = (28 * Math.PI) / 180;
      const eye = new Vector3(Math.cos(a) * Math.cos(e), Math.sin(a) * Math.cos(e), Math.sin(e));
      const half = Math.max((radius * 0.9) / aspect, radius * 0.45 + tall * 0.4);
      this.stage.look(target, eye, half, false);
    } else if (name === "plan") {
      // A hair off the vertical: it says which way is up on the picture.
      const eye = new Vector3(...across).multiplyScalar(-1e-4).add(new Vector3(0, 0, 1));
      this.stage.look(target, eye.normalize(), inPlan, true);
    } else {
      const eye = name === "front" ? new Vector3(...across).negate() : new Vector3(...along);
      this.stage.look(target, eye, upright, true);
    }
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
    const before = this.slice;
    this.slice = name;
    this.applySlice();
    if (name === "off" && before !== "off") this.setView("iso");
    if (name !== "off" && name !== before) {
      // Where the clouds agree is seen by whose points are whose.
      if (before === "off" && this.scene.sources.length > 1) this.setColour("source");
      this.setView({ level: "plan", along: "front", across: "side" }[name]);
    }
    this.changed();
  }

  // share: 0..1 of the way through the building.
  setPosition(share) {
    this.position[this.slice] = Math.min(1, Math.max(0, share));
    this.applySlice();
    this.changed();
  }

  setThickness(thickness) {
    this.thickness = thickness;
    this.applySlice();
    this.changed();
  }

  // Range of the slice's position, metres: heights for a level slice, else about the middle.
  get range() {
    const { floor, top, radius } = this.scene;
    return this.slice === "level" ? [floor, top] : [-radius, radius];
  }

  get positionMetres() {
    const [low, high] = this.range;
    return low + (high - low) * this.position[this.slice];
  }

  get step() {
    const [low, high] = this.range;
    return this.thickness / 2 / (high - low);
  }

  applySlice() {
    if (this.slice === "off") {
      this.stage.setSlab([0, 0, 1], 0, -1);
      return;
    }
    const normal = { level: this.axes.up, along: this.axes.across, across: this.axes.along }[this.slice];
    const centre = this.scene.centre;
    const middle = this.slice === "level" ? 0 : normal.reduce((sum, n, axis) => sum + n * centre[axis], 0);
    this.stage.setSlab(normal, middle + this.positionMetres, this.thickness / 2);
  }

  get where() {
    const at = this.positionMetres;
    if (this.slice === "level") return `${(at - this.scene.floor).toFixed(2)} m above the ground`;
    return `${at >= 0 ? "+" : "−"}${Math.abs(at).toFixed(2)} m from the middle`;
  }
}

function axesOf(yaw) {
  const c = Math.cos((yaw * Math.PI) / 180), s = Math.sin((yaw * Math.PI) / 180);
  return { along: [c, s, 0], across: [-s, c, 0] };
}

// Grips that are dragged along one direction in space: the slice's, and the six of the cut box.
import { Vector3 } from "three";
import { svg } from "./tools.js";

const SHORTEST = 0.12; // of its full length on the picture: seen more end-on, a grip is of no use
const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

export class Handles {
  constructor(state, overlay) {
    this.state = state;
    this.stage = state.stage;
    this.lines = svg(overlay, "g", { class: "frame" });
    this.grips = svg(overlay, "g");
    this.nodes = new Map();
    this.stage.onDraw.add(() => this.draw());
  }

  // What can be dragged now: {id, label, point, axis, move(metres), step}.
  wanted() {
    const { state } = this;
    const found = [];
    if (state.slice !== "off") {
      const { normal } = state.slab;
      found.push({ id: "slice", label: "move the slice", point: this.slabMiddle(), axis: normal,
        move: (metres) => state.moveSlice(metres), step: state.thickness / 2 });
    }
    if (state.isBoxed) {
      const names = ["along", "across", "height"];
      state.boxAxes.forEach((axis, k) => {
        for (const side of ["low", "high"]) {
          found.push({ id: `box-${k}-${side}`, label: `${side === "low" ? "lower" : "upper"} side of the box, ${names[k]}`,
            point: this.boxPoint([0, 1, 2].map((i) => (i === k ? state.box[side][k] : (state.box.low[i] + state.box.high[i]) / 2))),
            axis, move: (metres) => state.setBoxSide(k, side, state.box[side][k] + metres), step: 0.1 });
        }
      });
    }
    return found;
  }

  boxPoint(along) {
    const { centre } = this.state.scene;
    return [0, 1, 2].map((i) => centre[i] + this.state.boxAxes.reduce((sum, axis, k) => sum + axis[i] * along[k], 0));
  }

  slabMiddle() {
    const { state } = this;
    const { normal, zero } = state.slab;
    const { centre } = state.scene;
    const off = zero + state.positionMetres - normal.reduce((sum, n, i) => sum + n * centre[i], 0);
    return centre.map((value, i) => value + normal[i] * off);
  }

  draw() {
    this.lines.replaceChildren();
    const wanted = this.wanted();
    const isTurned = this.drawSlab(wanted.find(({ id }) => id === "slice"));
    this.drawBox();
    const kept = new Set();
    for (const handle of wanted) {
      if (handle.id === "slice" && !isTurned) continue;
      const perMetre = this.perMetre(handle);
      if (!perMetre) continue;
      kept.add(handle.id);
      const node = this.nodes.get(handle.id) ?? this.make(handle.id);
      const [x, y] = this.stage.project(handle.point);
      const angle = (Math.atan2(perMetre[1], perMetre[0]) * 180) / Math.PI;
      node.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${angle.toFixed(1)})`);
      node.setAttribute("aria-label", handle.label);
      node.handle = handle;
    }
    for (const [id, node] of this.nodes) {
      if (kept.has(id)) continue;
      node.remove();
      this.nodes.delete(id);
    }
  }

  // Pixels on the picture per metre along a grip's axis; null where it is seen end-on or behind.
  perMetre({ point, axis }) {
    const { stage } = this;
    const here = stage.project(point);
    if (here[2] < -1 || here[2] > 1) return null;
    const step = 0.02 * stage.halfHeight;
    const there = stage.project(point.map((value, i) => value + axis[i] * step));
    const found = [(there[0] - here[0]) / step, (there[1] - here[1]) / step];
    const full = stage.canvas.clientHeight / (2 * stage.halfHeight);
    return Math.hypot(...found) > SHORTEST * full ? found : null;
  }

  make(id) {
    const node = svg(this.grips, "g", { class: "grip", tabindex: 0, role: "slider" });
    svg(node, "circle", { r: 17, class: "reach" });
    svg(node, "circle", { r: 10, class: "knob" });
    svg(node, "path", { d: "M-5 -3.5L-8.5 0L-5 3.5M5 -3.5L8.5 0L5 3.5M-8 0H8", class: "arrow" });
    this.nodes.set(id, node);
    let last = null;
    node.addEventListener("pointerdown", (event) => {
      node.setPointerCapture(event.pointerId);
      last = [event.clientX, event.clientY];
      event.preventDefault();
      event.stopPropagation();
      node.focus({ preventScroll: true });
    });
    node.addEventListener("pointermove", (event) => {
      if (!last) return;
      const [x, y] = [event.clientX - last[0], event.clientY - last[1]];
      last = [event.clientX, event.clientY];
      const perMetre = this.perMetre(node.handle);
      if (perMetre) node.handle.move((x * perMetre[0] + y * perMetre[1]) / (perMetre[0] ** 2 + perMetre[1] ** 2));
    });
    for (const end of ["pointerup", "pointercancel"]) node.addEventListener(end, () => { last = null; });
    node.addEventListener("keydown", (event) => {
      const sign = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1 }[event.key];
      if (!sign) return;
      event.preventDefault();
      event.stopPropagation();
      node.handle.move(sign * node.handle.step);
    });
    return node;
  }

  segment(a, b, kind) {
    const [[x1, y1, z1], [x2, y2, z2]] = [a, b].map((point) => this.stage.project(point));
    if (Math.abs(z1) > 1 || Math.abs(z2) > 1) return; // behind the eye
    svg(this.lines, "line", { class: kind, x1: x1.toFixed(1), y1: y1.toFixed(1), x2: x2.toFixed(1), y2: y2.toFixed(1) });
  }

  drawBox() {
    if (!this.state.isBoxed) return;
    const { low, high } = this.state.box;
    const corners = Array.from({ length: 8 }, (_, i) =>
      this.boxPoint([i & 1 ? high[0] : low[0], i & 2 ? high[1] : low[1], i & 4 ? high[2] : low[2]]));
    for (const [i, j] of EDGES) this.segment(corners[i], corners[j], "edge");
  }

  // The slice's outline, where it is seen from aside; says whether it was.
  drawSlab(handle) {
    if (!handle) return false;
    const ahead = this.stage.camera.getWorldDirection(new Vector3());
    if (Math.abs(ahead.dot(new Vector3(...handle.axis))) > 0.995) return false;
    const { radius, floor, top } = this.state.scene;
    const one = handle.axis[2] > 0.5 ? this.state.axes.along : [0, 0, 1];
    const two = handle.axis[2] > 0.5 ? this.state.axes.across : [-handle.axis[1], handle.axis[0], 0];
    const a = handle.axis[2] > 0.5 ? radius * 0.8 : (top - floor) * 0.6, b = radius * 0.8;
    const corners = [[-a, -b], [a, -b], [a, b], [-a, b]].map(([u, v]) =>
      handle.point.map((value, i) => value + u * one[i] + v * two[i]));
    corners.forEach((corner, i) => this.segment(corner, corners[(i + 1) % 4], "edge"));
    return true;
  }
}

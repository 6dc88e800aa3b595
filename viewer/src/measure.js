// Measuring between two picked points, drawn over the picture.
import { metres } from "./dom.js";

const SVG = "http://www.w3.org/2000/svg";

export class Measure {
  constructor(stage, overlay, say) {
    this.stage = stage;
    this.overlay = overlay;
    this.say = say;
    this.isOn = false;
    this.points = [];
    stage.onDraw.add(() => this.draw());
    let down = null;
    stage.canvas.addEventListener("pointerdown", (event) => {
      down = event.isPrimary ? [event.clientX, event.clientY] : null;
    });
    stage.canvas.addEventListener("pointerup", (event) => {
      const moved = down ? Math.hypot(event.clientX - down[0], event.clientY - down[1]) : Infinity;
      if (this.isOn && moved < 5 && event.button === 0) this.click(event);
    });
  }

  setOn(isOn) {
    this.isOn = isOn;
    this.stage.canvas.classList.toggle("measuring", isOn);
    this.clear();
    this.say(isOn ? "Click the first point." : "");
  }

  clear() {
    this.points = [];
    if (this.isOn) this.say("Click the first point.");
    this.stage.invalidate();
  }

  click(event) {
    const box = this.stage.canvas.getBoundingClientRect();
    const reach = event.pointerType === "touch" ? 18 : 8;
    const found = this.stage.pick(event.clientX - box.left, event.clientY - box.top, reach);
    if (!found) {
      this.say("There is no point there; click on a point.");
      return;
    }
    if (this.points.length === 2) this.points = [];
    this.points.push(found);
    this.say(this.words());
    this.stage.invalidate();
  }

  get result() {
    if (this.points.length < 2) return null;
    const [a, b] = this.points.map((found) => found.point);
    const [dx, dy, dz] = a.map((value, axis) => b[axis] - value);
    return { distance: Math.hypot(dx, dy, dz), plan: Math.hypot(dx, dy), rise: dz };
  }

  words() {
    const { sources, origin, precision_m: precision } = this.stage.scene;
    const place = (found) => {
      const at = found.point.map((value, axis) => (value + origin[axis]).toFixed(3)).join("  ");
      return `${sources[found.source]?.name ?? ""}: ${at}`;
    };
    const lines = this.points.map(place);
    const result = this.result;
    if (!result) return `${lines[0]}\nClick the second point.`;
    const { distance, plan, rise } = result;
    // Both ends may be off by `precision` along all three axes.
    const most = 2 * Math.sqrt(3) * precision * 1000;
    const doubt = precision ? ` (rounding: ${most.toFixed(1)} mm at most)` : "";
    return [
      `${metres(distance)}${doubt}`, `in plan ${metres(plan)}, rise ${metres(rise)}`, ...lines,
    ].join("\n");
  }

  draw() {
    this.overlay.replaceChildren();
    const at = this.points.map((found) => this.stage.project(found.point));
    const add = (tag, attributes) => {
      const node = document.createElementNS(SVG, tag);
      for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
      this.overlay.append(node);
      return node;
    };
    if (at.length === 2) {
      const [[x1, y1], [x2, y2]] = at;
      for (const kind of ["halo", "ruler"]) add("line", { class: kind, x1, y1, x2, y2 });
      const label = add("text", { x: (x1 + x2) / 2, y: (y1 + y2) / 2 - 10 });
      label.textContent = metres(this.result.distance);
    }
    for (const [cx, cy] of at) {
      add("circle", { class: "halo", cx, cy, r: 6 });
      add("circle", { class: "ruler", cx, cy, r: 6 });
    }
  }
}

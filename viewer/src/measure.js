// Measuring between two picked points, drawn over the picture.
import { metres, signed } from "./dom.js";
import { svg } from "./tools.js";

export class Measure {
  constructor(stage) {
    this.stage = stage;
    this.points = [];
    this.hint = "Click the first point.";
  }

  clear() {
    this.points = [];
  }

  pick(found) {
    if (this.points.length === 2) this.points = [];
    this.points.push(found);
    return this.words();
  }

  get result() {
    if (this.points.length < 2) return null;
    const [a, b] = this.points.map((found) => found.point);
    const [dx, dy, dz] = a.map((value, axis) => b[axis] - value);
    return { distance: Math.hypot(dx, dy, dz), plan: Math.hypot(dx, dy), dx, dy, dz };
  }

  // Coordinates as the file has them (metres), to the digit that the picture holds.
  place(found) {
    const { sources, origin, precision_m: precision } = this.stage.scene;
    const source = sources[found.source];
    const name = source?.name ?? "";
    if (this.stage.progress < 1 && source?.motion) return `${name}: shown as delivered, not in the result's coordinates`;
    const digits = precision && precision > 4e-4 ? 3 : 4;
    const from = source?.origin ?? origin;
    return `${name}: ${found.point.map((value, axis) => (value + from[axis]).toFixed(digits)).join("  ")}`;
  }

  words() {
    const lines = this.points.map((found, index) => `${"AB"[index]}  ${this.place(found)}`);
    const { result } = this;
    if (!result) return `${lines[0]}\nClick the second point.`;
    const { distance, plan, dx, dy, dz } = result;
    const { precision_m: precision } = this.stage.scene;
    // Both ends may be off by `precision` along all three axes.
    const most = 2 * Math.sqrt(3) * precision * 1000;
    const doubt = precision ? ` (rounding: ${most.toFixed(1)} mm at most)` : "";
    return [
      `${metres(distance)}${doubt}`, `in plan ${metres(plan)}, heading ${heading(dx, dy)}`,
      `dx ${signed(dx)}   dy ${signed(dy)}   dz ${signed(dz)}`, ...lines,
    ].join("\n");
  }

  draw(layer) {
    const at = this.points.map((found) => this.stage.project(found.point));
    if (at.length === 2) {
      const [[x1, y1], [x2, y2]] = at;
      for (const kind of ["halo", "ruler"]) svg(layer, "line", { class: kind, x1, y1, x2, y2 });
      svg(layer, "text", { x: (x1 + x2) / 2, y: (y1 + y2) / 2 - 10 }, metres(this.result.distance));
    }
    at.forEach(([cx, cy], index) => {
      for (const kind of ["halo", "ruler"]) svg(layer, "circle", { class: kind, cx, cy, r: 6 });
      svg(layer, "text", { class: "small", x: cx + 13, y: cy - 8 }, "AB"[index]);
    });
  }
}

// Of the way from A to B: degrees from the grid's north (+y), clockwise.
function heading(dx, dy) {
  if (Math.hypot(dx, dy) < 1e-3) return "–";
  return `${(((Math.atan2(dx, dy) * 180) / Math.PI + 360) % 360).toFixed(1)}°`;
}

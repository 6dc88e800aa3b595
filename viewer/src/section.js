// Drawing the line of an upright section: two clicks, in any view.
import { svg } from "./tools.js";

export class Section {
  constructor(state, done) {
    this.state = state;
    this.done = done;
    this.free = true; // a line may begin beside the building
    this.points = [];
    this.hint = "Click two places: the section runs through them.";
  }

  begin() {
    this.state.setSlice("off");
    this.state.setView("plan");
  }

  clear() {
    this.points = [];
  }

  pick(found, at) {
    this.points.push(found ? found.point : this.state.stage.onPlane(at, this.state.scene.centre[2]));
    if (this.points.length < 2) return "Click the second place.";
    const [a, b] = this.points;
    if (Math.hypot(b[0] - a[0], b[1] - a[1]) < 0.05) {
      this.points.pop();
      return "The two places are one in plan; click another one.";
    }
    this.done(a, b);
    return null;
  }

  draw(layer) {
    for (const point of this.points) {
      const [cx, cy] = this.state.stage.project(point);
      for (const kind of ["halo", "ruler"]) svg(layer, "circle", { class: kind, cx, cy, r: 6 });
    }
  }
}

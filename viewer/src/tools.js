// What a click into the picture does: one tool at a time, or none.
//
// A tool has: hint (what to click first), pick(found, event) -> words to show, clear(), draw(layer),
// and optionally cursor, free (a click beside every point counts too) and end().

const SVG = "http://www.w3.org/2000/svg";
const SLACK = 5; // pixels that a click may move

export function svg(parent, tag, attributes = {}, text = null) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== null) node.textContent = text;
  parent.append(node);
  return node;
}

export class Tools extends EventTarget {
  constructor(stage, overlay, say) {
    super();
    Object.assign(this, { stage, say, current: null, all: {} });
    this.layer = svg(overlay, "g");
    stage.onDraw.add(() => this.draw());
    let down = null;
    stage.canvas.addEventListener("pointerdown", (event) => {
      down = event.isPrimary ? [event.clientX, event.clientY] : null;
    });
    stage.canvas.addEventListener("pointerup", (event) => {
      const moved = down ? Math.hypot(event.clientX - down[0], event.clientY - down[1]) : Infinity;
      if (this.current && moved < SLACK && event.button === 0) this.click(event);
    });
  }

  add(name, tool) {
    this.all[name] = tool;
    return tool;
  }

  isOn(name) {
    return this.current !== null && this.current === this.all[name];
  }

  toggle(name) {
    this.choose(this.isOn(name) ? null : name);
  }

  choose(name) {
    this.current?.clear();
    this.current = name ? this.all[name] : null;
    this.current?.clear();
    this.current?.begin?.();
    this.stage.canvas.classList.toggle("picking", Boolean(this.current));
    this.say(this.current?.hint ?? "");
    this.stage.invalidate();
    this.dispatchEvent(new Event("change"));
  }

  click(event) {
    const box = this.stage.canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    const found = this.stage.pick(...at, event.pointerType === "touch" ? 18 : 8);
    if (!found && !this.current.free) {
      this.say("There is no point there; click on a point.");
      return;
    }
    const words = this.current.pick(found, at);
    if (words !== null) this.say(words);
    this.stage.invalidate();
  }

  draw() {
    this.layer.replaceChildren();
    this.current?.draw(this.layer);
  }
}

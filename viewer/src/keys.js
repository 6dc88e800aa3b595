// The keyboard: what each key does, and the list of them.
import { h } from "./dom.js";
import { SLICES, VIEWS } from "./state.js";

const KEYS = [
  ["1 2 3 4 5 6", "views: corner, plan, front, right, back, left"],
  ["Z", "fit what is shown into the picture"],
  ["C", "next colouring"],
  ["B", "as delivered / registered"],
  ["S", "next slice"],
  ["[ ] or Shift + wheel", "move the slice by half its thickness"],
  ["X", "cut box on or off"],
  ["M", "measure between two points"],
  ["Esc", "end measuring or drawing"],
  ["+ −", "larger, smaller points"],
  ["L", "depth shading on or off"],
  ["O", "parallel or perspective view"],
  ["F", "full screen"],
  ["R", "reset everything"],
  ["? or H", "this list"],
  ["drag", "turn; with the right button or two fingers: move"],
  ["wheel, pinch", "nearer or farther (in a page: after a click into the picture)"],
  ["Tab", "goes to the handles of the slice and the box; arrow keys move them"],
];

export function makeHelp() {
  const help = h("dialog", { class: "help" });
  help.append(h("h3", {}, "Keys and gestures"),
    h("table", {}, ...KEYS.map(([key, does]) => h("tr", {}, h("th", {}, key), h("td", {}, does)))),
    h("button", { type: "button", onclick: () => help.close() }, "Close"));
  return help;
}

const next = (names, current) => names[(names.indexOf(current) + 1) % names.length];

export function toggleFull(root) {
  if (document.fullscreenElement) document.exitFullscreen();
  else root.requestFullscreen?.();
}

export function listen(state, tools, root, help) {
  const slices = () => SLICES.filter((name) => name !== "drawn" || state.line);
  const step = (sign) => state.slice !== "off" && state.moveSlice((sign * state.thickness) / 2);
  const acts = {
    z: () => state.fit(),
    c: () => state.setColour(next(state.colours, state.colour)),
    b: () => state.hasMotion && state.setRegistered(!state.isRegistered),
    s: () => state.setSlice(next(slices(), state.slice)),
    "[": () => step(-1),
    "]": () => step(1),
    x: () => state.setBoxed(!state.isBoxed),
    m: () => tools.toggle("measure"),
    escape: () => tools.choose(null),
    "+": () => state.setSize(state.size * 1.25),
    "=": () => state.setSize(state.size * 1.25),
    "-": () => state.setSize(state.size / 1.25),
    l: () => state.setLighting(!state.stage.lighting),
    o: () => state.stage.setOrtho(!state.stage.isOrtho),
    f: () => toggleFull(root),
    r: () => { tools.choose(null); state.reset(); },
    h: () => help.showModal(),
    "?": () => help.showModal(),
  };
  VIEWS.forEach((view, index) => { acts[String(index + 1)] = () => state.setView(view); });
  root.addEventListener("keydown", (event) => {
    const { tagName, type } = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || tagName === "SELECT" || type === "text") return;
    const act = acts[event.key.toLowerCase()];
    if (!act) return;
    event.preventDefault();
    act();
  });
  // Before the camera hears of it: with Shift the wheel moves the slice, not the eye.
  state.stage.canvas.addEventListener("wheel", (event) => {
    if (!event.shiftKey || state.slice === "off") return;
    event.preventDefault();
    event.stopImmediatePropagation();
    step((event.deltaY || event.deltaX) > 0 ? -1 : 1);
  }, { passive: false, capture: true });
}

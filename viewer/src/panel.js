// The controls: buttons that call the state, and that show what it says.
import { CLASSES, HEIGHT, RESIDUAL, hex } from "./colours.js";
import { h } from "./dom.js";
import { SLICES, THICKNESSES, VIEWS } from "./state.js";

const WORDS = {
  source: "Source", height: "Height", natural: "Natural", residual: "Distance", class: "Class",
  iso: "Corner", plan: "Plan", front: "Front", side: "Side",
  off: "Off", level: "Level", along: "Along", across: "Across",
};

export const KEYS = [
  ["1 2 3 4", "corner, plan, front, side"],
  ["C", "next colouring"],
  ["B", "as delivered / registered"],
  ["S", "next slice"],
  ["[ ]", "move the slice by half its thickness"],
  ["M", "measure between two points; Esc ends it"],
  ["+ −", "larger, smaller points"],
  ["L", "depth shading on or off"],
  ["O", "parallel or perspective view"],
  ["F", "full screen"],
  ["R", "reset everything"],
  ["? or H", "this list"],
  ["drag", "turn; with the right button or two fingers: move"],
  ["wheel, pinch", "nearer or farther (in a page: after a click into the picture)"],
];

let groups = 0;

// A row of buttons of which one is pressed.
function choice(label, names, current, choose, refreshers) {
  const id = `viewer-group-${(groups += 1)}`;
  const buttons = names.map((name) =>
    h("button", { type: "button", "data-value": name, onclick: () => choose(name) }, WORDS[name] ?? name));
  refreshers.push(() => {
    for (const button of buttons) button.setAttribute("aria-pressed", button.dataset.value === current());
  });
  return h("div", { class: "group", role: "group", "aria-labelledby": id },
    h("span", { class: "label", id }, label), h("div", { class: "buttons" }, ...buttons));
}

function slider(label, attributes, oninput) {
  const input = h("input", { type: "range", "aria-label": label, ...attributes });
  input.addEventListener("input", () => oninput(Number(input.value)));
  return input;
}

export function makePanel(state, measure, root) {
  const refreshers = [];
  const { scene } = state;
  const parts = [];
  if (state.hasMotion) {
    parts.push(choice("Clouds are", ["as delivered", "registered"],
      () => (state.isRegistered ? "registered" : "as delivered"),
      (name) => state.setRegistered(name === "registered"), refreshers));
  }
  parts.push(clouds(state, refreshers));
  parts.push(choice("Colour", state.colours, () => state.colour, (name) => state.setColour(name), refreshers));
  parts.push(choice("View", VIEWS, () => state.view, (name) => state.setView(name), refreshers));
  parts.push(slices(state, refreshers));
  const help = h("dialog", { class: "help" });
  help.append(h("h3", {}, "Keys"),
    h("table", {}, ...KEYS.map(([key, does]) => h("tr", {}, h("th", {}, key), h("td", {}, does)))),
    h("button", { type: "button", onclick: () => help.close() }, "Close"));
  parts.push(tools(state, measure, root, help, refreshers));
  const panel = h("div", { class: "panel" }, ...parts);
  const refresh = () => refreshers.forEach((refresher) => refresher());
  state.addEventListener("change", refresh);
  refresh();
  root.addEventListener("keydown", (event) => onKey(event, state, measure, root, help));
  return { panel, help, scene };
}

function clouds(state, refreshers) {
  const boxes = state.scene.sources.map((source, index) => {
    const input = h("input", { type: "checkbox" });
    input.addEventListener("change", () => state.setShown(index, input.checked));
    refreshers.push(() => { input.checked = state.shown[index]; });
    const swatch = h("i", { class: "swatch", style: `background:${hex(source.colour)}` });
    return h("label", { class: "cloud" }, input, swatch, h("span", {}, source.name),
      source.role ? h("small", {}, source.role) : null);
  });
  return h("div", { class: "group" }, h("span", { class: "label" }, "Show"), ...boxes);
}

function slices(state, refreshers) {
  const where = h("output", { class: "where" });
  const position = slider("position of the slice", { min: 0, max: 1, step: "any", class: "slice-position" },
    (value) => state.setPosition(value));
  const thickness = h("select", { "aria-label": "thickness of the slice", class: "slice-thickness" },
    ...THICKNESSES.map((t) => h("option", { value: t }, t < 1 ? `${t * 100} cm` : `${t} m`)));
  thickness.addEventListener("change", () => state.setThickness(Number(thickness.value)));
  const more = h("div", { class: "slice" }, position,
    h("div", { class: "row" }, where, h("label", {}, "thick ", thickness)));
  refreshers.push(() => {
    more.hidden = state.slice === "off";
    if (more.hidden) return;
    position.value = state.position[state.slice];
    thickness.value = state.thickness;
    where.textContent = state.where;
  });
  const row = choice("Thin slice", SLICES, () => state.slice, (name) => state.setSlice(name), refreshers);
  row.append(more);
  return row;
}

function tools(state, measure, root, help, refreshers) {
  const ruler = h("button", { type: "button", class: "measure", onclick: () => toggleMeasure(state, measure) }, "Measure");
  const shading = h("button", { type: "button", onclick: () => state.setLighting(!state.stage.lighting) }, "Shading");
  const full = h("button", { type: "button", onclick: () => toggleFull(root) }, "Full screen");
  const size = slider("size of the points", { min: -2, max: 2, step: 0.1 }, (value) => state.setSize(2 ** value));
  refreshers.push(() => {
    ruler.setAttribute("aria-pressed", measure.isOn);
    shading.setAttribute("aria-pressed", state.stage.lighting);
    size.value = Math.log2(state.size);
  });
  return h("div", { class: "group" }, h("span", { class: "label" }, "Tools"),
    h("div", { class: "buttons" }, ruler, shading, document.fullscreenEnabled ? full : null,
      h("button", { type: "button", onclick: () => { measure.setOn(false); state.reset(); } }, "Reset"),
      h("button", { type: "button", onclick: () => help.showModal() }, "Keys")),
    h("label", { class: "size" }, h("span", {}, "Points"), size));
}

function toggleMeasure(state, measure) {
  measure.setOn(!measure.isOn);
  state.changed();
}

function toggleFull(root) {
  if (document.fullscreenElement) document.exitFullscreen();
  else root.requestFullscreen();
}

const next = (names, current) => names[(names.indexOf(current) + 1) % names.length];

function onKey(event, state, measure, root, help) {
  const { tagName, type } = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey || tagName === "SELECT" || type === "text") return;
  const view = VIEWS[Number(event.key) - 1];
  const act = {
    c: () => state.setColour(next(state.colours, state.colour)),
    b: () => state.hasMotion && state.setRegistered(!state.isRegistered),
    s: () => state.setSlice(next(SLICES, state.slice)),
    "[": () => state.slice !== "off" && state.setPosition(state.position[state.slice] - state.step),
    "]": () => state.slice !== "off" && state.setPosition(state.position[state.slice] + state.step),
    m: () => toggleMeasure(state, measure),
    escape: () => { measure.setOn(false); state.changed(); },
    "+": () => state.setSize(state.size * 1.25),
    "=": () => state.setSize(state.size * 1.25),
    "-": () => state.setSize(state.size / 1.25),
    l: () => state.setLighting(!state.stage.lighting),
    o: () => state.stage.setOrtho(!state.stage.isOrtho),
    f: () => toggleFull(root),
    r: () => { measure.setOn(false); state.reset(); },
    h: () => help.showModal(),
    "?": () => help.showModal(),
  }[event.key.toLowerCase()];
  if (!view && !act) return;
  event.preventDefault();
  if (view) state.setView(view);
  else act();
}

// What the colours mean, over the picture.
export function makeLegend(state) {
  const legend = h("div", { class: "viewer-legend" });
  const ramp = (stops, low, high, title) => [
    h("span", {}, title), h("span", { class: "ramp" }, h("span", {}, low),
      h("i", { style: `background:linear-gradient(90deg,${stops.join(",")})` }), h("span", {}, high))];
  const { scene } = state;
  const kinds = {
    source: () => scene.sources.map((source) => h("span", { class: "key" },
      h("i", { class: "swatch", style: `background:${hex(source.colour)}` }), source.name)),
    height: () => ramp(HEIGHT, "0", `${(scene.top - scene.floor).toFixed(1)} m`, "height above the ground"),
    natural: () => [scene.natural ?? "colours of the files"],
    residual: () => [...ramp(RESIDUAL, "0", `${Math.round(scene.residual.shown_m * 1000)} mm`, "distance to the other cloud"),
      h("span", { class: "key" }, h("i", { class: "swatch", style: "background:#8c8c8c" }),
        `none within ${Math.round(scene.residual.reach_m * 1000)} mm`)],
    class: () => CLASSES.filter(([code]) => !scene.classes || scene.classes.includes(code)).map(([, name, colour]) =>
      h("span", { class: "key" }, h("i", { class: "swatch", style: `background:${colour}` }), name)),
  };
  state.addEventListener("change", () => legend.replaceChildren(...kinds[state.colour]()));
  legend.replaceChildren(...kinds[state.colour]());
  return legend;
}

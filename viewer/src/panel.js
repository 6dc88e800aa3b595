// The controls: buttons that call the state, and that show what it says.
import { hex } from "./colours.js";
import { h } from "./dom.js";
import { toggleFull } from "./keys.js";
import { SLICES, THICKNESSES, VIEWS } from "./state.js";

const WORDS = {
  source: "Source", height: "Height", natural: "Natural", residual: "Distance", class: "Class", reason: "Removed",
  iso: "Corner", plan: "Plan", front: "Front", right: "Right", back: "Back", left: "Left",
  off: "Off", level: "Level", along: "Along", across: "Across", drawn: "Drawn",
};

let groups = 0;

// A row of buttons of which one is pressed.
export function choice(label, names, current, choose, refreshers) {
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

const button = (words, onclick, more = {}) => h("button", { type: "button", onclick, ...more }, words);

export function makePanel(state, tools, root, help, extras = []) {
  const refreshers = [];
  const parts = [];
  if (state.hasMotion) {
    parts.push(choice("Clouds are", ["as delivered", "registered"],
      () => (state.isRegistered ? "registered" : "as delivered"),
      (name) => state.setRegistered(name === "registered"), refreshers));
  }
  parts.push(clouds(state, refreshers));
  parts.push(choice("Colour", state.colours, () => state.colour, (name) => state.setColour(name), refreshers));
  const views = choice("View", VIEWS, () => state.view, (name) => state.setView(name), refreshers);
  views.querySelector(".buttons").append(button("Fit", () => state.fit(), { class: "fit", title: "fit what is shown into the picture" }));
  parts.push(views, slices(state, tools, refreshers), useTools(state, tools, root, help, refreshers), ...extras);
  const panel = h("div", { class: "panel" }, ...parts);
  const refresh = () => refreshers.forEach((refresher) => refresher());
  state.addEventListener("change", refresh);
  tools.addEventListener("change", refresh);
  refresh();
  return panel;
}

function clouds(state, refreshers) {
  const boxes = state.scene.sources.map((source, index) => {
    const input = h("input", { type: "checkbox" });
    input.addEventListener("change", () => state.setShown(index, input.checked));
    refreshers.push(() => { input.checked = state.shown[index]; });
    const swatch = h("i", { class: "swatch", style: `background:${hex(source.colour)}` });
    return h("label", { class: "cloud" }, input, swatch, h("span", { title: source.name }, source.name),
      source.role ? h("small", {}, source.role) : null);
  });
  return h("div", { class: "group" }, h("span", { class: "label" }, "Show"), ...boxes);
}

function slices(state, tools, refreshers) {
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
  const isDrawing = () => tools.isOn("section");
  const row = choice("Thin slice", SLICES, () => (isDrawing() ? "drawn" : state.slice), (name) => {
    if (name === "drawn" && !(state.line && state.slice !== "drawn")) return tools.toggle("section");
    if (isDrawing()) tools.choose(null);
    return state.setSlice(name);
  }, refreshers);
  row.append(more);
  return row;
}

function useTools(state, tools, root, help, refreshers) {
  const ruler = button("Measure", () => tools.toggle("measure"), { class: "measure" });
  const shading = button("Shading", () => state.setLighting(!state.stage.lighting));
  const box = button("Cut box", () => state.setBoxed(!state.isBoxed), { class: "cut-box" });
  const edges = h("output", { class: "where" });
  const boxed = h("div", { class: "row" }, edges, button("Whole", () => state.resetBox(), { class: "whole-box" }));
  const size = slider("size of the points", { min: -2, max: 2, step: 0.1 }, (value) => state.setSize(2 ** value));
  refreshers.push(() => {
    ruler.setAttribute("aria-pressed", tools.isOn("measure"));
    shading.setAttribute("aria-pressed", state.stage.lighting);
    box.setAttribute("aria-pressed", state.isBoxed);
    boxed.hidden = !state.isBoxed;
    edges.textContent = `box ${state.box.high.map((value, k) => (value - state.box.low[k]).toFixed(2)).join(" × ")} m`;
    size.value = Math.log2(state.size);
  });
  return h("div", { class: "group" }, h("span", { class: "label" }, "Tools"),
    h("div", { class: "buttons" }, ruler, box, shading,
      document.fullscreenEnabled ? button("Full screen", () => toggleFull(root)) : null,
      button("Reset", () => { tools.choose(null); state.reset(); }),
      button("Keys", () => help.showModal())),
    boxed,
    h("label", { class: "size" }, h("span", {}, "Points"), size));
}

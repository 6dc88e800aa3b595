// Puts a viewer into an element: the picture, what lies over it, the controls.
import { h, lengthText, roundLength } from "./dom.js";
import { Handles } from "./handles.js";
import { listen, makeHelp } from "./keys.js";
import { makeLegend } from "./legend.js";
import { Measure } from "./measure.js";
import { makePanel } from "./panel.js";
import { Section } from "./section.js";
import { Stage } from "./stage.js";
import { State } from "./state.js";
import { Tools } from "./tools.js";

export function hasWebGl() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

// The picture with what lies over it, and no controls: {picture, stage, state, tools, say, status}.
export function makePicture(root, scene, label) {
  const canvas = h("canvas", { tabindex: 0, "aria-label": label, role: "application" });
  const overlay = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  overlay.setAttribute("class", "overlay");
  const readout = h("div", { class: "readout", role: "status", hidden: true });
  const bar = h("div", { class: "scale-bar" });
  const status = h("div", { class: "loading", role: "status" }, "Loading the points …");
  const picture = h("div", { class: "stage" }, canvas, overlay, readout, bar, status);
  root.append(picture);
  const stage = new Stage(canvas, scene);
  const say = (text) => {
    readout.textContent = text;
    readout.hidden = !text;
  };
  const state = new State(stage);
  const handles = new Handles(state, overlay);
  const tools = new Tools(stage, overlay, say);
  picture.append(makeLegend(state));
  followTheme(stage, root);
  showScale(stage, bar);
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
  return { picture, stage, state, tools, handles, say, status };
}

// isPage: the viewer is the whole page, so that the wheel need not scroll anything else.
// extras: more groups for the panel, made from the viewer.
export function makeViewer(root, scene, isPage, extras = () => []) {
  root.replaceChildren();
  const made = makePicture(root, scene, "point clouds in three dimensions; press ? for the keys");
  const { stage, state, tools } = made;
  const measure = tools.add("measure", new Measure(stage));
  tools.add("section", new Section(state, (a, b) => {
    tools.choose(null);
    state.drawSlice(a, b);
  }));
  const help = makeHelp();
  const viewer = { ...made, measure, help, root };
  root.append(makePanel(state, tools, root, help, extras(viewer)), help);
  listen(state, tools, root, help);
  if (!isPage) zoomOnlyInFocus(stage, root);
  return viewer;
}

function followTheme(stage, root) {
  const apply = () => stage.setGround(getComputedStyle(root).getPropertyValue("--plate").trim() || "#ffffff");
  apply();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
}

// In a report the wheel and an upright swipe scroll the page until the picture has been clicked.
function zoomOnlyInFocus(stage, root) {
  const apply = (isIn) => {
    stage.controls.enableZoom = isIn;
    stage.canvas.style.touchAction = isIn ? "none" : "pan-y";
  };
  root.addEventListener("focusin", () => apply(true));
  root.addEventListener("focusout", () => setTimeout(() => apply(root.contains(document.activeElement))));
  apply(false);
}

function showScale(stage, bar) {
  stage.onDraw.add(() => {
    bar.hidden = !stage.isOrtho;
    if (bar.hidden) return;
    const perPixel = (2 * stage.halfHeight) / stage.canvas.clientHeight;
    const length = roundLength(perPixel * stage.canvas.clientWidth * 0.22);
    bar.style.width = `${length / perPixel}px`;
    bar.textContent = lengthText(length);
  });
}

// What a test or a curious reader can ask the viewer.
export function expose(viewer, more = {}) {
  const { stage, state, measure, tools } = viewer;
  window.dougongViewer = {
    stage, state, measure, tools,
    project: (x, y, z) => {
      const box = stage.canvas.getBoundingClientRect();
      const [left, top] = stage.project([x, y, z]);
      return [box.left + left, box.top + top];
    },
    get points() {
      let count = 0;
      for (const chunk of stage.chunks) if (chunk.visible) count += chunk.userData.position.length / 3;
      return count;
    },
    ...more,
  };
}

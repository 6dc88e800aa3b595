// Puts a viewer into an element: the picture, what lies over it, the controls.
import { h, lengthText, roundLength } from "./dom.js";
import { Measure } from "./measure.js";
import { makeLegend, makePanel } from "./panel.js";
import { Stage } from "./stage.js";
import { State } from "./state.js";

export function hasWebGl() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

// isPage: the viewer is the whole page, so that the wheel need not scroll anything else.
export function makeViewer(root, scene, isPage) {
  const canvas = h("canvas", {
    tabindex: 0, "aria-label": "point clouds in three dimensions; press ? for the keys", role: "application",
  });
  const overlay = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  overlay.setAttribute("class", "overlay");
  const readout = h("div", { class: "readout", role: "status" });
  const bar = h("div", { class: "scale-bar" });
  const status = h("div", { class: "loading", role: "status" }, "Loading the points …");
  const picture = h("div", { class: "stage" }, canvas, overlay, readout, bar, status);
  root.replaceChildren(picture);
  const stage = new Stage(canvas, scene);
  const say = (text) => {
    readout.textContent = text;
    readout.hidden = !text;
  };
  say("");
  const measure = new Measure(stage, overlay, say);
  const state = new State(stage);
  picture.append(makeLegend(state));
  const { panel, help } = makePanel(state, measure, root);
  root.append(panel, help);
  followTheme(stage, root);
  showScale(stage, bar);
  if (!isPage) zoomOnlyInFocus(stage, root);
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
  return { stage, state, measure, status, root };
}

function followTheme(stage, root) {
  const apply = () => stage.setGround(getComputedStyle(root).getPropertyValue("--plate").trim() || "#ffffff");
  apply();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
}

// In a report the wheel scrolls the page until the picture has been clicked.
function zoomOnlyInFocus(stage, root) {
  const apply = () => { stage.controls.enableZoom = root.contains(document.activeElement); };
  root.addEventListener("focusin", apply);
  root.addEventListener("focusout", () => setTimeout(apply));
  stage.controls.enableZoom = false;
  stage.canvas.addEventListener("touchstart", () => { stage.controls.enableZoom = true; }, { passive: true });
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
  const { stage, state, measure } = viewer;
  window.dougongViewer = {
    stage, state, measure,
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

// What the colours mean, over the picture.
import { CLASSES, HEIGHT, NONE, REASONS, RESIDUAL, SIGNED, hex } from "./colours.js";
import { h } from "./dom.js";

const key = (colour, words) => h("span", { class: "legend-key" },
  h("i", { class: "swatch", style: `background:${colour}` }), words);

function ramp(stops, low, high, title) {
  return [h("span", {}, title), h("span", { class: "ramp" }, h("span", {}, low),
    h("i", { style: `background:linear-gradient(90deg,${stops.join(",")})` }), h("span", {}, high))];
}

function residual({ shown_m: shown, reach_m: reach, is_signed: isSigned, title, signs }) {
  const most = `${+(shown * 1000).toPrecision(3)} mm`;
  const scale = isSigned
    ? ramp(SIGNED, `−${most}`, `+${most}`, title)
    : ramp(RESIDUAL, "0", most, title ?? "distance to the other cloud");
  const none = reach ? `none within ${+(reach * 1000).toPrecision(3)} mm` : "no value";
  return [...scale, signs ? h("span", { class: "quiet" }, signs) : null, key(NONE, none)];
}

export function makeLegend(state) {
  const legend = h("div", { class: "viewer-legend" });
  const { scene } = state;
  const kinds = {
    source: () => scene.sources.map((source, index) => (state.shown[index] ? key(hex(source.colour), source.name) : null)),
    height: () => ramp(HEIGHT, "0", `${(scene.top - scene.floor).toFixed(1)} m`, "height above the ground"),
    natural: () => [scene.natural ?? "colours of the files"],
    residual: () => residual(scene.residual),
    class: () => CLASSES.filter(([code]) => !scene.classes || scene.classes.includes(code))
      .map(([, name, colour]) => key(colour, name)),
    reason: () => REASONS.filter(([code]) => scene.reasons.includes(code)).map(([, name, colour]) => key(colour, name)),
  };
  const refresh = () => legend.replaceChildren(...kinds[state.colour]().filter(Boolean));
  state.addEventListener("change", refresh);
  refresh();
  return legend;
}

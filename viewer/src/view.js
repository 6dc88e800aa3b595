// The viewer behind `dougong view`: clouds of any size, streamed from this computer.
import { createLazPerf } from "laz-perf/lib/web";
import wasm from "laz-perf/lib/web/laz-perf.wasm";
import { Matrix4, Vector3 } from "three";
import { h } from "./dom.js";
import { Rescue } from "./rescue.js";
import { ALONE } from "./shaders.js";
import { Stream, Streamer } from "./stream.js";
import { expose, hasWebGl, makePicture, makeViewer } from "./viewer.js";

const SOFTWARE = /swiftshader|llvmpipe|software/i;

// Points drawn at once: what a graphics card does easily, and what a processor alone can do.
function budgetOf(renderer) {
  const gl = renderer.getContext();
  const known = gl.getExtension("WEBGL_debug_renderer_info");
  const name = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  return SOFTWARE.test(name) ? 500_000 : 3_000_000;
}

// The part worth looking at, from the coarsest nodes: lone points and removed ones do not count.
function place(scene, all) {
  const kept = all.filter(({ userData: { info } }) => info.length && info[2] < 32);
  const chunks = kept.length ? kept : all;
  const values = [[], [], []];
  for (const { userData: { position, info } } of chunks) {
    for (let i = 0; i < position.length; i++) if (info[4 * Math.floor(i / 3) + 3] !== ALONE) values[i % 3].push(position[i]);
  }
  const at = (list, share) => list[Math.min(list.length - 1, Math.floor(share * list.length))];
  const sorted = values.map((list) => Float64Array.from(list).sort());
  const middle = [at(sorted[0], 0.5), at(sorted[1], 0.5)];
  const plan = values[0].map((x, i) => [x - middle[0], values[1][i] - middle[1]]);
  const reach = Float64Array.from(plan, ([x, y]) => Math.hypot(x, y)).sort();
  // The coarsest level is even over the site: what matters lies about its middle, where slopes and
  // trees at the rim have no say.
  scene.radius = Math.max(at(reach, 0.85), 0.1);
  const near = values[2].filter((_, i) => Math.hypot(...plan[i]) < 0.6 * scene.radius);
  const heights = near.length > 100 ? Float64Array.from(near).sort() : sorted[2];
  scene.floor = at(heights, 0.03);
  scene.top = Math.max(at(heights, 0.9995), scene.floor + 0.1);
  scene.reach = Math.max(reach[reach.length - 1], scene.top - scene.floor, scene.radius) * 1.2;
  scene.centre = [...middle, (scene.floor + scene.top) / 2];
  scene.level = Math.min(0.5, 1.5 / (scene.top - scene.floor));
  const high = plan.filter((_, i) => values[2][i] > scene.floor + 0.2 * (scene.top - scene.floor));
  scene.yaw_deg = wallDirection(high.length > 100 ? high : plan, scene.radius);
}

// The yaw (0..90 degrees) at which the plan's histograms are sharpest, as the report finds it.
function wallDirection(plan, radius) {
  const stride = Math.max(1, Math.floor(plan.length / 20_000));
  let best = 0, bestScore = -1;
  for (let yaw = 0; yaw < 90; yaw += 2) {
    const c = Math.cos((yaw * Math.PI) / 180), s = Math.sin((yaw * Math.PI) / 180);
    const counts = [new Float64Array(200), new Float64Array(200)];
    for (let i = 0; i < plan.length; i += stride) {
      const [x, y] = plan[i];
      [x * c + y * s, y * c - x * s].forEach((value, axis) => {
        const bin = Math.floor((100 * (value + radius)) / radius);
        if (bin >= 0 && bin < 200) counts[axis][bin] += 1;
      });
    }
    const score = counts.reduce((sum, list) => sum + list.reduce((part, count) => part + count * count, 0), 0);
    if (score > bestScore) [best, bestScore] = [yaw, score];
  }
  return best;
}

// Back to where a cloud was delivered: turned about the common middle.
function motions(scene) {
  for (const source of scene.sources) {
    if (!source.turn) continue;
    const [a, b, c] = [0, 3, 6].map((row) => source.turn.slice(row, row + 3));
    const shift = [a, b, c].map((row, axis) =>
      scene.centre[axis] - row.reduce((sum, value, k) => sum + value * scene.centre[k], 0));
    source.motion = [...a, shift[0], ...b, shift[1], ...c, shift[2], 0, 0, 0, 1];
    source.centre = scene.centre;
  }
}

const held = { add: (chunk) => ({ userData: chunk }) }; // roots wait here until there is a stage

// Opens streams, makes a picture of their roots, and keeps it filled.
async function opened(clouds, lazPerf, stats, make, before = () => {}) {
  const streams = clouds.map((cloud) => new Stream(held, cloud, lazPerf, stats));
  await Promise.all(streams.map((stream) => stream.open()));
  before(streams);
  await Promise.all(streams.map((stream) => stream.load("0-0-0-0")));
  const roots = streams.map((stream) => stream.nodes.get("0-0-0-0"));
  const viewer = make(roots.map((entry) => entry.chunk));
  const { stage, status } = viewer;
  streams.forEach((stream, index) => {
    stream.stage = stage;
    roots[index].chunk = stage.add(roots[index].chunk.userData);
  });
  const total = clouds.reduce((sum, cloud) => sum + cloud.points, 0);
  const streamer = new Streamer(stage, streams, budgetOf(stage.renderer), (_, isDone, error) => {
    const points = streams.reduce((sum, stream) => sum + stream.points, 0);
    status.textContent = error
      ? `A part could not be read: ${error.message}`
      : `${points.toLocaleString("en")} of ${total.toLocaleString("en")} points read${isDone ? "" : " …"}`;
    streamer.isDone = isDone;
  });
  status.classList.add("quiet");
  stage.draw();
  return { ...viewer, streams, streamer };
}

// One cloud alone, about its own middle, for picking.
async function pane(box, scene, index, lazPerf, stats) {
  const cloud = { ...scene.clouds[index], source: 0, source_ids: null };
  const own = {
    ...scene, clouds: [cloud], colours: ["natural", "height", "class"].filter((name) => scene.colours.includes(name)),
    sources: [{ ...scene.sources[scene.clouds[index].source], motion: null, role: null, name: cloud.name }],
  };
  let toFile = null, toLocal = null;
  const made = await opened([cloud], lazPerf, stats, (chunks) => {
    place(own, chunks);
    return makePicture(box, own, `${cloud.name} in three dimensions; click a place to pick it`);
  }, ([stream]) => {
    const middle = stream.middle().map(Math.floor);
    stream.toLocal.premultiply(new Matrix4().makeTranslation(...middle.map((value) => -value)));
    own.sources[0].origin = middle.map((value, axis) => value + (own.sources[0].origin ?? scene.origin)[axis]);
    const back = stream.toLocal.clone().invert();
    toLocal = (file) => new Vector3(...file).applyMatrix4(stream.toLocal).toArray();
    toFile = (local) => new Vector3(...local).applyMatrix4(back).toArray();
  });
  return { ...made, name: cloud.name, toFile, toLocal };
}

// The group "Pairs" of the panel, where there are two clouds to pick in.
function pairsGroup(viewer, scene, lazPerf, stats) {
  if (!scene.pairs) return [];
  const { root } = viewer;
  const enter = async () => {
    const usual = [...root.childNodes];
    const boxes = h("div", { class: "panes" });
    root.classList.add("rescue");
    root.replaceChildren(boxes);
    const source = await pane(boxes, scene, 0, lazPerf, stats);
    const target = await pane(boxes, scene, 1, lazPerf, stats);
    const rescue = new Rescue(root, { source, target }, scene.pairs, () => {
      for (const { stage } of [source, target]) stage.dispose();
      root.classList.remove("rescue");
      root.replaceChildren(...usual);
      window.dougongViewer.rescue = null;
      viewer.stage.resize();
    });
    root.append(rescue.panel);
    window.dougongViewer.rescue = rescue;
  };
  const button = h("button", { type: "button", class: "pick-pairs", onclick: () => enter().catch((error) => viewer.say(`The two clouds could not be opened: ${error.message}`)) }, "Pick pairs");
  return [h("div", { class: "group" }, h("span", { class: "label" }, "Register by hand"), h("div", { class: "buttons" }, button))];
}

async function start() {
  const root = document.getElementById("viewer");
  if (!hasWebGl()) throw new Error("this browser draws no 3-D: WebGL 2 is missing or switched off");
  const began = performance.now();
  const scene = JSON.parse(document.getElementById("viewer-scene").textContent);
  const stats = { bytes: 0, requests: 0, nodes: 0, points: 0 };
  const lazPerf = await createLazPerf({ wasmBinary: wasm });
  const viewer = await opened(scene.clouds, lazPerf, stats, (chunks) => {
    place(scene, chunks);
    motions(scene);
    return makeViewer(root, scene, true, (made) => pairsGroup(made, scene, lazPerf, stats));
  });
  const first = { milliseconds: performance.now() - began, bytes: stats.bytes };
  expose(viewer, { stats, first, streamer: viewer.streamer, ready: first.milliseconds });
  document.documentElement.classList.add("viewer-ready");
}

start().catch((error) => {
  const root = document.getElementById("viewer");
  root.textContent = `The clouds could not be shown: ${error.message}`;
  root.classList.add("failed");
  console.error(error);
});

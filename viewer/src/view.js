// The viewer behind `dougong view`: clouds of any size, streamed from this computer.
import { createLazPerf } from "laz-perf/lib/web";
import wasm from "laz-perf/lib/web/laz-perf.wasm";
import { Stream, Streamer } from "./stream.js";
import { expose, hasWebGl, makeViewer } from "./viewer.js";

const SOFTWARE = /swiftshader|llvmpipe|software/i;

// Points drawn at once: what a graphics card does easily, and what a processor alone can do.
function budgetOf(renderer) {
  const gl = renderer.getContext();
  const known = gl.getExtension("WEBGL_debug_renderer_info");
  const name = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  return SOFTWARE.test(name) ? 500_000 : 3_000_000;
}

// The part worth looking at, from the coarsest nodes: strays do not count.
function place(scene, chunks) {
  const values = [[], [], []];
  for (const { userData: { position } } of chunks) {
    for (let i = 0; i < position.length; i++) values[i % 3].push(position[i]);
  }
  const at = (list, share) => list[Math.min(list.length - 1, Math.floor(share * list.length))];
  const sorted = values.map((list) => Float64Array.from(list).sort());
  const middle = [at(sorted[0], 0.5), at(sorted[1], 0.5)];
  const reach = values[0].map((x, i) => Math.hypot(x - middle[0], values[1][i] - middle[1])).sort((a, b) => a - b);
  scene.floor = at(sorted[2], 0.03);
  scene.top = Math.max(at(sorted[2], 0.9995), scene.floor + 0.1);
  scene.radius = Math.max(at(reach, 0.95), 0.1);
  scene.reach = Math.max(reach[reach.length - 1], scene.top - scene.floor, scene.radius) * 1.2;
  scene.centre = [...middle, (scene.floor + scene.top) / 2];
  scene.level = Math.min(0.5, 1.5 / (scene.top - scene.floor));
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

async function start() {
  const root = document.getElementById("viewer");
  if (!hasWebGl()) throw new Error("this browser draws no 3-D: WebGL 2 is missing or switched off");
  const began = performance.now();
  const scene = JSON.parse(document.getElementById("viewer-scene").textContent);
  const stats = { bytes: 0, requests: 0, nodes: 0, points: 0 };
  const lazPerf = await createLazPerf({ wasmBinary: wasm });
  const held = { add: (chunk) => ({ userData: chunk }) }; // the roots wait here until there is a stage
  const streams = scene.clouds.map((cloud) => new Stream(held, cloud, lazPerf, stats));
  await Promise.all(streams.map((stream) => stream.open()));
  await Promise.all(streams.map((stream) => stream.load("0-0-0-0")));
  const roots = streams.map((stream) => stream.nodes.get("0-0-0-0"));
  place(scene, roots.map((entry) => entry.chunk));
  motions(scene);
  const viewer = makeViewer(root, scene, true);
  const { stage, status } = viewer;
  streams.forEach((stream, index) => {
    stream.stage = stage;
    roots[index].chunk = stage.add(roots[index].chunk.userData);
  });
  const total = scene.clouds.reduce((sum, cloud) => sum + cloud.points, 0);
  const streamer = new Streamer(stage, streams, budgetOf(stage.renderer), (_, isDone, error) => {
    status.textContent = error
      ? `A part could not be read: ${error.message}`
      : `${stats.points.toLocaleString("en")} of ${total.toLocaleString("en")} points read${isDone ? "" : " …"}`;
    streamer.isDone = isDone;
  });
  status.classList.add("quiet");
  stage.draw();
  const first = { milliseconds: performance.now() - began, bytes: stats.bytes };
  expose(viewer, { stats, first, streamer, ready: first.milliseconds });
  document.documentElement.classList.add("viewer-ready");
}

start().catch((error) => {
  const root = document.getElementById("viewer");
  root.textContent = `The clouds could not be shown: ${error.message}`;
  root.classList.add("failed");
  console.error(error);
});

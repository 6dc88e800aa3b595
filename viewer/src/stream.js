// A COPC file of any size, by byte ranges: the nodes of its octree that the picture needs now.
import { Copc } from "copc";
import { Box3, Frustum, Matrix4, Vector3 } from "three";
import { packed, residualCode } from "./decode.js";
import { ALONE } from "./shaders.js";

const PARALLEL = 4;
const FINE_PIXELS = 1.6; // a node is opened while its points are farther apart than this
const STAY = 1.2; // what is drawn already counts for a little more: nothing comes and goes at a rim
const LEAST_SHARE = 1 / 3; // what a cut node costs at least: its hidden points are looked at too
const READ = { float: { 4: "getFloat32", 8: "getFloat64" }, unsigned: { 1: "getUint8", 2: "getUint16" } };
const BASE_LENGTH = { 6: 30, 7: 36, 8: 38 };

export class Stream {
  constructor(stage, cloud, lazPerf, stats) {
    Object.assign(this, { stage, cloud, lazPerf, stats });
    this.nodes = new Map(); // key -> {count, node, chunk, wanted, loading}
    this.pages = new Map();
    this.points = 0; // read so far
    this.toLocal = new Matrix4().set(...cloud.to_local);
    this.get = (begin, end) => this.range(begin, end);
  }

  async range(begin, end, signal) {
    const { cloud, stats } = this;
    const answer = await fetch(cloud.url, { headers: { Range: `bytes=${begin}-${end - 1}` }, signal });
    if (answer.status !== 206) throw new Error(`${cloud.name}: the server answered ${answer.status}`);
    const bytes = new Uint8Array(await answer.arrayBuffer());
    stats.bytes += bytes.length;
    stats.requests += 1;
    return bytes;
  }

  async open() {
    this.copc = await Copc.create(this.get);
    const { header, info, eb } = this.copc;
    this.rgbAt = header.pointDataRecordFormat >= 7 ? 30 : null;
    let at = BASE_LENGTH[header.pointDataRecordFormat];
    for (const field of eb) {
      const read = READ[field.type]?.[field.length];
      if (field.name === "source_id") this.sourceAt = at;
      if (read && field.name === "dougong_reason") this.reasonAt = at;
      if (read && field.name === this.cloud.residual) this.residual = { at, read, scale: field.scale ?? 1 };
      at += field.length;
    }
    const [x0, y0, z0, x1] = info.cube;
    this.corner = [x0, y0, z0];
    this.edge = x1 - x0;
    this.perUnit = Math.cbrt(Math.abs(this.toLocal.determinant()));
    this.spacing = info.spacing * this.perUnit;
    await this.page(info.rootHierarchyPage);
  }

  async page(page) {
    const { nodes, pages } = await Copc.loadHierarchyPage(this.get, page);
    for (const [key, node] of Object.entries(nodes)) if (node) this.nodes.set(key, { key, node });
    for (const [key, next] of Object.entries(pages)) if (next) this.pages.set(key, next);
  }

  // The middle of the file's extent, local metres.
  middle() {
    const { min, max } = this.copc.header;
    return new Vector3(...min.map((value, axis) => (value + max[axis]) / 2)).applyMatrix4(this.toLocal).toArray();
  }

  // A node's cube in local metres.
  boxOf(depth, x, y, z) {
    const size = this.edge / 2 ** depth;
    const low = [x, y, z].map((cell, axis) => this.corner[axis] + cell * size);
    const box = new Box3(new Vector3(...low), new Vector3(...low.map((value) => value + size)));
    return box.applyMatrix4(this.toLocal);
  }

  // Returns what the picture would like, in no order: {key, entry, urgency, spacing}. Large on the
  // picture comes first, and of two alike what lies nearer its middle.
  wanted(eye) {
    const found = [];
    const visit = (depth, x, y, z, most) => {
      const key = `${depth}-${x}-${y}-${z}`;
      const entry = this.nodes.get(key);
      if (!entry) {
        if (this.pages.has(key)) found.push({ stream: this, key, urgency: Infinity, count: 0, cost: 0 });
        return;
      }
      const box = this.boxOf(depth, x, y, z);
      if (!eye.sees(box, this.cloud)) return;
      const spacing = this.spacing / 2 ** depth;
      const pixels = spacing * eye.pixelsPerMetre(box);
      const stay = entry.chunk?.visible ? STAY : 1;
      // A node never comes before its parent.
      const urgency = depth === 0 ? Infinity : Math.min(0.999 * most, pixels * eye.centrality(box) * stay);
      const count = entry.node.pointCount;
      found.push({ stream: this, key, entry, depth, urgency, spacing, count, cost: count * eye.share(box) });
      if (pixels < FINE_PIXELS) return;
      for (let i = 0; i < 8; i++) visit(depth + 1, 2 * x + (i & 1), 2 * y + ((i >> 1) & 1), 2 * z + (i >> 2), urgency);
    };
    visit(0, 0, 0, 0, Infinity);
    return found;
  }

  async load(key) {
    if (this.pages.has(key)) {
      const page = this.pages.get(key);
      this.pages.delete(key);
      await this.page(page);
      return;
    }
    const entry = this.nodes.get(key);
    const { header } = this.copc;
    entry.stop = new AbortController();
    const get = (begin, end) => this.range(begin, end, entry.stop.signal);
    const raw = await Copc.loadPointDataBuffer(get, header, entry.node, this.lazPerf);
    const points = this.decoded(raw, entry.node.pointCount);
    const [depth, ...cell] = key.split("-").map(Number);
    entry.spacing = Math.max(this.spacing / 2 ** depth, spread(points, this.boxOf(depth, ...cell)));
    entry.chunk = this.stage.add(points);
    this.stats.nodes += 1;
    this.stats.points += entry.node.pointCount;
    this.points += entry.node.pointCount;
  }

  decoded(raw, count) {
    const { header } = this.copc;
    const { scale, offset, pointDataRecordLength: length } = header;
    const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
    const e = this.toLocal.elements;
    const position = new Float32Array(3 * count), colour = new Uint8Array(3 * count), info = new Uint8Array(4 * count);
    const { source_ids: ids, source, grey } = this.cloud;
    const { residual } = this;
    const most = this.cloud.code_max_m ?? 1;
    for (let i = 0, at = 0; i < count; i++, at += length) {
      const x = view.getInt32(at, true) * scale[0] + offset[0];
      const y = view.getInt32(at + 4, true) * scale[1] + offset[1];
      const z = view.getInt32(at + 8, true) * scale[2] + offset[2];
      position[3 * i] = e[0] * x + e[4] * y + e[8] * z + e[12];
      position[3 * i + 1] = e[1] * x + e[5] * y + e[9] * z + e[13];
      position[3 * i + 2] = e[2] * x + e[6] * y + e[10] * z + e[14];
      const red = this.rgbAt === null ? 0 : view.getUint16(at + 30, true);
      const green = this.rgbAt === null ? 0 : view.getUint16(at + 32, true);
      const blue = this.rgbAt === null ? 0 : view.getUint16(at + 34, true);
      if (red || green || blue) {
        const shift = this.cloud.colour_bits === 8 ? 0 : 8;
        colour[3 * i] = red >> shift;
        colour[3 * i + 1] = green >> shift;
        colour[3 * i + 2] = blue >> shift;
      } else {
        const share = (view.getUint16(at + 12, true) - grey[0]) / Math.max(grey[1] - grey[0], 1);
        colour.fill(30 + 215 * Math.min(1, Math.max(0, share)), 3 * i, 3 * i + 3);
      }
      info[4 * i] = ids && this.sourceAt ? (ids[view.getUint8(at + this.sourceAt)] ?? 0) : source;
      info[4 * i + 1] = residual ? residualCode(view[residual.read](at + residual.at, true) * residual.scale, most) : 255;
      info[4 * i + 2] = packed(view.getUint8(at + 16), this.reasonAt ? view.getUint8(at + this.reasonAt) : 0);
    }
    return { position, colour, info, spacing: this.spacing };
  }
}

// Decides which nodes of all clouds are drawn, fetches what is missing, drops what is old.
export class Streamer {
  constructor(stage, streams, budget, report) {
    Object.assign(this, { stage, streams, budget, report });
    this.loading = 0;
    this.clock = 0;
    stage.onDraw.add(() => this.update());
  }

  // What the eye sees of boxes: the picture's frustum, the slice, the cut box.
  eye() {
    const { stage } = this;
    const { camera } = stage;
    camera.updateMatrixWorld();
    const matrix = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    const frustum = new Frustum().setFromProjectionMatrix(matrix);
    const height = stage.canvas.clientHeight;
    const { slab, slabHalf, box: cut, boxHalf, motion, source } = stage.uniforms;
    const cuts = [];
    if (slabHalf.value >= 0) cuts.push([slab.value, slabHalf.value]);
    if (boxHalf.value.x >= 0) cut.value.forEach((axis, k) => cuts.push([axis, boxHalf.value.getComponent(k)]));
    return {
      sees: (box, cloud) => {
        const sources = cloud.source_ids ? Object.values(cloud.source_ids) : [cloud.source];
        const shown = sources.filter((index) => source.value[index].w > 0.5);
        return shown.some((index) => {
          const moved = box.clone().applyMatrix4(motion.value[index]);
          return frustum.intersectsBox(moved) && cuts.every(([axis, half]) => reaches(moved, axis, half));
        });
      },
      // How much of a node is drawn, roughly: a slice takes little of each, so that more of them fit.
      share: (box) => {
        const size = box.getSize(new Vector3());
        const parts = cuts.map(([axis, half]) =>
          (2 * half) / (size.x * Math.abs(axis.x) + size.y * Math.abs(axis.y) + size.z * Math.abs(axis.z)));
        return Math.max(LEAST_SHARE, Math.min(1, ...parts));
      },
      pixelsPerMetre: (box) => {
        if (stage.isOrtho) return height / (2 * stage.halfHeight);
        const distance = Math.max(box.distanceToPoint(camera.position), camera.near);
        return height / (2 * Math.tan((camera.fov * Math.PI) / 360) * distance);
      },
      centrality: (box) => {
        const at = box.getCenter(new Vector3()).project(camera);
        return 1 / (1 + 0.5 * Math.min(2, Math.hypot(at.x, at.y)));
      },
    };
  }

  update() {
    const eye = this.eye();
    const wanted = this.streams.flatMap((stream) => stream.wanted(eye));
    wanted.sort((a, b) => (a.urgency === b.urgency ? 0 : b.urgency - a.urgency));
    let points = 0;
    const chosen = [];
    for (const want of wanted) {
      if (points + want.cost > this.budget && chosen.length) break;
      points += want.cost;
      chosen.push(want);
    }
    this.show(chosen);
    this.fetch(chosen);
    this.report(this, chosen.every((want) => want.entry?.chunk || want.count === 0));
  }

  show(chosen) {
    this.clock += 1;
    for (const { entry } of chosen) if (entry) entry.used = this.clock;
    // A dot is as large as the points around it lie apart: those of its node, or of what is drawn
    // inside that, each by its number of points.
    const inside = new Map();
    for (const want of chosen.filter((each) => each.entry?.chunk).reverse()) {
      const within = inside.get(want.entry);
      const own = within ? Math.min(want.entry.spacing, within.sum / within.points) : want.entry.spacing;
      this.stage.setSpacing(want.entry.chunk, own * 1.3);
      const [depth, x, y, z] = want.key.split("-").map(Number);
      const parent = want.stream.nodes.get(`${depth - 1}-${x >> 1}-${y >> 1}-${z >> 1}`);
      if (!parent) continue;
      const { sum, points } = inside.get(parent) ?? { sum: 0, points: 0 };
      inside.set(parent, { sum: sum + own * want.count, points: points + want.count });
    }
    let cached = 0;
    const old = [];
    let changed = false;
    for (const stream of this.streams) {
      for (const entry of stream.nodes.values()) {
        if (!entry.chunk) continue;
        const isShown = entry.used === this.clock;
        if (entry.chunk.visible !== isShown) changed = true;
        entry.chunk.visible = isShown;
        cached += entry.node.pointCount;
        if (!isShown) old.push([entry, stream]);
      }
    }
    old.sort((a, b) => (a[0].used ?? 0) - (b[0].used ?? 0));
    for (const [entry] of old) {
      if (cached < 2.5 * this.budget) break;
      cached -= entry.node.pointCount;
      this.stage.remove(entry.chunk);
      entry.chunk = null;
    }
    if (changed) this.stage.invalidate();
  }

  // Fetches what is missing, most urgent first; what nobody wants any more is not waited for.
  fetch(chosen) {
    for (const stream of this.streams) {
      for (const entry of stream.nodes.values()) if (entry.loading && entry.used !== this.clock) entry.stop?.abort();
    }
    for (const { stream, key, entry, count } of chosen) {
      if (this.loading >= PARALLEL) return;
      const isPage = stream.pages.has(key);
      if (!isPage && (!entry || entry.chunk || entry.loading || count === 0)) continue;
      if (entry) entry.loading = true;
      this.loading += 1;
      const complain = (error) => { if (error.name !== "AbortError") this.report(this, false, error); };
      stream.load(key).catch(complain).finally(() => {
        this.loading -= 1;
        if (entry) entry.loading = false;
        this.stage.invalidate();
      });
    }
  }
}

// Whether a box comes within `half` of the plane (unit normal and position: a Vector4).
function reaches(box, plane, half) {
  const middle = box.getCenter(new Vector3()), size = box.getSize(new Vector3()).multiplyScalar(0.5);
  const off = middle.x * plane.x + middle.y * plane.y + middle.z * plane.z - plane.w;
  return Math.abs(off) <= half + size.x * Math.abs(plane.x) + size.y * Math.abs(plane.y) + size.z * Math.abs(plane.z);
}

// Returns how far apart the points of a node lie on its surfaces, with what its parents add: half
// as many more again (a node at the tree's end may hold few points, whatever its depth says).
// Marks points that stand alone: they are no surface, and are drawn small.
function spread({ position, info }, box) {
  const cells = 32, wide = cells + 2, seen = new Uint16Array(wide ** 3);
  const size = box.getSize(new Vector3());
  const edge = Math.max(size.x, size.y, size.z) / cells;
  const count = info.length / 4, places = new Int32Array(count);
  const cell = (value, low) => 1 + Math.min(cells - 1, Math.max(0, Math.floor((value - low) / edge)));
  let filled = 0;
  for (let i = 0; i < count; i++) {
    const x = cell(position[3 * i], box.min.x), y = cell(position[3 * i + 1], box.min.y), z = cell(position[3 * i + 2], box.min.z);
    const at = (x * wide + y) * wide + z;
    if (seen[at] === 0) filled += 1;
    if (seen[at] < 65535) seen[at] += 1;
    places[i] = at;
  }
  for (let i = 0; i < count; i++) {
    let near = 0;
    for (let dx = -1; dx <= 1 && near < 4; dx++) {
      for (let dy = -1; dy <= 1; dy++) {
        for (let dz = -1; dz <= 1; dz++) near += seen[places[i] + (dx * wide + dy) * wide + dz];
      }
    }
    if (near < 4) info[4 * i + 3] = ALONE;
  }
  return Math.sqrt((filled * edge * edge) / (1.5 * count));
}

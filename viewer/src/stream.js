// A COPC file of any size, by byte ranges: the nodes of its octree that the picture needs now.
import { Copc } from "copc";
import { Box3, Frustum, Matrix4, Vector3 } from "three";

const PARALLEL = 4;
const FINE_PIXELS = 1.6; // a node is opened while its points are farther apart than this
const BASE_LENGTH = { 6: 30, 7: 36, 8: 38 };

export class Stream {
  constructor(stage, cloud, lazPerf, stats) {
    Object.assign(this, { stage, cloud, lazPerf, stats });
    this.nodes = new Map(); // key -> {count, node, chunk, wanted, loading}
    this.pages = new Map();
    this.toLocal = new Matrix4().set(...cloud.to_local);
    this.get = async (begin, end) => {
      const answer = await fetch(cloud.url, { headers: { Range: `bytes=${begin}-${end - 1}` } });
      if (answer.status !== 206) throw new Error(`${cloud.name}: the server answered ${answer.status}`);
      const bytes = new Uint8Array(await answer.arrayBuffer());
      stats.bytes += bytes.length;
      stats.requests += 1;
      return bytes;
    };
  }

  async open() {
    this.copc = await Copc.create(this.get);
    const { header, info, eb } = this.copc;
    this.rgbAt = header.pointDataRecordFormat >= 7 ? 30 : null;
    let at = BASE_LENGTH[header.pointDataRecordFormat];
    for (const field of eb) {
      if (field.name === "source_id") this.sourceAt = at;
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

  // A node's cube in local metres.
  boxOf(depth, x, y, z) {
    const size = this.edge / 2 ** depth;
    const low = [x, y, z].map((cell, axis) => this.corner[axis] + cell * size);
    const box = new Box3(new Vector3(...low), new Vector3(...low.map((value) => value + size)));
    return box.applyMatrix4(this.toLocal);
  }

  // Returns what the picture would like, most urgent first: {key, entry, pixels, spacing}.
  wanted(frustum, eye) {
    const found = [];
    const visit = (depth, x, y, z) => {
      const key = `${depth}-${x}-${y}-${z}`;
      const entry = this.nodes.get(key);
      if (!entry) {
        if (this.pages.has(key)) found.push({ stream: this, key, pixels: Infinity, count: 0 });
        return;
      }
      const box = this.boxOf(depth, x, y, z);
      if (!frustum.intersectsBox(box)) return;
      const spacing = this.spacing / 2 ** depth;
      const pixels = spacing * eye.pixelsPerMetre(box);
      found.push({ stream: this, key, entry, depth, pixels, spacing, count: entry.node.pointCount });
      if (pixels < FINE_PIXELS) return;
      for (let i = 0; i < 8; i++) visit(depth + 1, 2 * x + (i & 1), 2 * y + ((i >> 1) & 1), 2 * z + (i >> 2));
    };
    visit(0, 0, 0, 0);
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
    const raw = await Copc.loadPointDataBuffer(this.get, header, entry.node, this.lazPerf);
    entry.chunk = this.stage.add(this.decoded(raw, entry.node.pointCount));
    entry.chunk.userData.depth = Number(key.split("-")[0]);
    this.stats.nodes += 1;
    this.stats.points += entry.node.pointCount;
  }

  decoded(raw, count) {
    const { header } = this.copc;
    const { scale, offset, pointDataRecordLength: length } = header;
    const view = new DataView(raw.buffer, raw.byteOffset, raw.byteLength);
    const e = this.toLocal.elements;
    const position = new Float32Array(3 * count), colour = new Uint8Array(3 * count), info = new Uint8Array(4 * count);
    const { source_ids: ids, source, grey } = this.cloud;
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
      info[4 * i + 1] = 255;
      info[4 * i + 2] = view.getUint8(at + 16);
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

  update() {
    const { stage } = this;
    const camera = stage.camera;
    camera.updateMatrixWorld();
    const matrix = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    const frustum = new Frustum().setFromProjectionMatrix(matrix);
    const height = stage.canvas.clientHeight;
    const eye = {
      pixelsPerMetre: (box) => {
        if (stage.isOrtho) return height / (2 * stage.halfHeight);
        const distance = Math.max(box.distanceToPoint(camera.position), camera.near);
        return height / (2 * Math.tan((camera.fov * Math.PI) / 360) * distance);
      },
    };
    const wanted = this.streams.flatMap((stream) => stream.wanted(frustum, eye));
    wanted.sort((a, b) => b.pixels - a.pixels);
    let points = 0;
    const chosen = [];
    for (const want of wanted) {
      if (points + want.count > this.budget && chosen.length) break;
      points += want.count;
      chosen.push(want);
    }
    this.show(chosen);
    this.fetch(chosen);
    this.report(this, chosen.every((want) => want.entry?.chunk || want.count === 0));
  }

  show(chosen) {
    this.clock += 1;
    for (const { entry } of chosen) if (entry) entry.used = this.clock;
    const finest = new Map(); // of each stream's node: the finest spacing drawn inside it
    for (const want of chosen.filter((each) => each.entry?.chunk).reverse()) {
      const own = finest.get(want.entry) ?? want.spacing;
      this.stage.setSpacing(want.entry.chunk, Math.min(own, want.spacing) * 1.3);
      const [depth, x, y, z] = want.key.split("-").map(Number);
      const parent = want.stream.nodes.get(`${depth - 1}-${x >> 1}-${y >> 1}-${z >> 1}`);
      if (parent) finest.set(parent, Math.min(finest.get(parent) ?? Infinity, own));
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

  fetch(chosen) {
    for (const { stream, key, entry, count } of chosen) {
      if (this.loading >= PARALLEL) return;
      const isPage = stream.pages.has(key);
      if (!isPage && (!entry || entry.chunk || entry.loading || count === 0)) continue;
      if (entry) entry.loading = true;
      this.loading += 1;
      stream.load(key).catch((error) => this.report(this, false, error)).finally(() => {
        this.loading -= 1;
        if (entry) entry.loading = false;
        this.stage.invalidate();
      });
    }
  }
}

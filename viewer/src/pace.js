// Keeps a slow machine responsive: while the view moves, only some of the points are drawn.
//
// Points are stored so that the first eighth of a chunk is every eighth of its points, the first
// quarter every fourth, and so on.

const SLOW_MS = 90;
const PARTS = 8;
const ORDER = [0, 4, 2, 6, 1, 3, 5, 7];

export function interleaved({ position, colour, info, spacing }) {
  const n = info.length / 4;
  const out = { position: new Float32Array(3 * n), colour: new Uint8Array(3 * n), info: new Uint8Array(4 * n), spacing };
  let to = 0;
  for (const part of ORDER) {
    for (let from = part; from < n; from += PARTS, to++) {
      for (let k = 0; k < 3; k++) {
        out.position[3 * to + k] = position[3 * from + k];
        out.colour[3 * to + k] = colour[3 * from + k];
      }
      for (let k = 0; k < 4; k++) out.info[4 * to + k] = info[4 * from + k];
    }
  }
  return out;
}

export class Pace {
  constructor(stage) {
    Object.assign(this, { stage, share: 1, isMoving: false, last: 0, slow: 0 });
  }

  begin() {
    this.isMoving = true;
    this.last = 0;
    this.apply();
  }

  end() {
    this.isMoving = false;
    this.apply();
  }

  // Called once a frame; isDrawn: this frame draws.
  tick(now, isDrawn) {
    if (this.isMoving && isDrawn && this.last) {
      const took = now - this.last;
      this.slow = took > SLOW_MS ? this.slow + 1 : 0;
      if (this.slow >= 2 && this.share > 1 / PARTS) {
        this.share /= 2;
        this.slow = 0;
        this.apply();
      } else if (took < SLOW_MS / 5 && this.share < 1) {
        this.share = Math.min(1, this.share * 1.05);
        this.apply();
      }
    }
    this.last = isDrawn ? now : 0;
  }

  apply() {
    const share = this.isMoving ? this.share : 1;
    for (const { geometry, userData } of this.stage.chunks) {
      geometry.setDrawRange(0, Math.ceil((userData.info.length / 4) * share));
    }
    this.stage.uniforms.thinned.value = 1 / Math.sqrt(share);
    this.stage.invalidate();
  }
}

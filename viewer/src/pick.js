// Which point lies under the pointer.
import { Matrix4, Vector3 } from "three";

// x, y: CSS pixels of the canvas. Of the points near the place, the one in front; null: none.
export function pick(stage, x, y, reachPixels = 7) {
  stage.ready();
  const view = new Matrix4().multiplyMatrices(stage.camera.projectionMatrix, stage.camera.matrixWorldInverse);
  const width = stage.canvas.clientWidth, height = stage.canvas.clientHeight;
  const e = view.elements;
  const isSlice = stage.uniforms.slabHalf.value >= 0;
  const eye = stage.camera.position, ahead = stage.camera.getWorldDirection(new Vector3());
  const angle = Math.tan((stage.perspective.fov * Math.PI) / 360);
  let best = null, bestScore = Infinity;
  for (const chunk of stage.chunks) {
    if (!chunk.visible) continue;
    const { position, info } = chunk.userData;
    for (let k = 0; k < info.length / 4; k++) {
      const at = stage.shownAt(position, info, k);
      if (!at) continue;
      const [px, py, pz] = at;
      const w = e[3] * px + e[7] * py + e[11] * pz + e[15];
      if (w <= 0) continue;
      const sx = ((e[0] * px + e[4] * py + e[8] * pz + e[12]) / w + 1) * 0.5 * width - x;
      if (Math.abs(sx) > reachPixels) continue;
      const sy = (1 - (e[1] * px + e[5] * py + e[9] * pz + e[13]) / w) * 0.5 * height - y;
      const off = Math.hypot(sx, sy);
      if (off > reachPixels) continue;
      // A step towards the eye counts for a third of a step sideways on the picture.
      const depth = (px - eye.x) * ahead.x + (py - eye.y) * ahead.y + (pz - eye.z) * ahead.z;
      const pixel = stage.isOrtho ? (2 * stage.halfHeight) / height : (2 * angle * w) / height;
      const score = isSlice ? off : off + (0.35 * depth) / pixel;
      if (score < bestScore) {
        bestScore = score;
        best = { point: [px, py, pz], source: info[4 * k], off };
      }
    }
  }
  return best;
}

// The best rigid pose of pairs of points, as registration/picked_pairs.py finds it.

const BAD_METRES = 0.05, BAD_RATIO = 3, THIN = 0.03;

const mean = (points) => [0, 1, 2].map((k) => points.reduce((sum, p) => sum + p[k], 0) / points.length);
const minus = (a, b) => a.map((value, k) => value - b[k]);
const rms = (values) => Math.sqrt(values.reduce((sum, value) => sum + value * value, 0) / values.length);

// Eigenvalues (largest first) and eigenvectors of a small symmetric matrix, by Jacobi's rotations.
export function eigen(matrix) {
  const n = matrix.length;
  const a = matrix.map((row) => [...row]);
  const v = a.map((_, i) => a.map((__, j) => (i === j ? 1 : 0)));
  for (let sweep = 0; sweep < 60; sweep++) {
    let off = 0;
    for (let p = 0; p < n; p++) for (let q = p + 1; q < n; q++) off += a[p][q] ** 2;
    if (off < 1e-28 * (1 + a.reduce((sum, row, i) => sum + row[i] ** 2, 0))) break;
    for (let p = 0; p < n; p++) {
      for (let q = p + 1; q < n; q++) {
        if (a[p][q] === 0) continue;
        const theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const t = (theta >= 0 ? 1 : -1) / (Math.abs(theta) + Math.hypot(theta, 1));
        const c = 1 / Math.hypot(t, 1), s = t * c;
        for (let k = 0; k < n; k++) [a[k][p], a[k][q]] = [c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]];
        for (let k = 0; k < n; k++) [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
        for (let k = 0; k < n; k++) [v[k][p], v[k][q]] = [c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]];
      }
    }
  }
  const order = a.map((_, i) => i).sort((i, j) => a[j][j] - a[i][i]);
  return { values: order.map((i) => a[i][i]), vectors: order.map((i) => v.map((row) => row[i])) };
}

// Returns point -> point: the rigid motion of least squares (Horn 1987, unit quaternions).
export function fitRigid(source, target) {
  const low = mean(source), high = mean(target);
  const s = [0, 1, 2].map(() => [0, 0, 0]);
  source.forEach((p, i) => {
    const a = minus(p, low), b = minus(target[i], high);
    for (let j = 0; j < 3; j++) for (let k = 0; k < 3; k++) s[j][k] += a[j] * b[k];
  });
  const [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s;
  const { vectors: [[w, x, y, z]] } = eigen([
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ]);
  const turn = [
    [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
  ];
  const rotate = (p) => turn.map((row) => row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
  const move = (p) => rotate(minus(p, low)).map((value, k) => value + high[k]);
  return { move, rotate };
}

function misses({ move }, source, target) {
  return source.map((p, i) => Math.hypot(...minus(move(p), target[i])));
}

// The pair that the others contradict; -1: none. Three pairs can all be bad together.
function badOf(source, target) {
  if (source.length < 4) return -1;
  let best = Infinity, bad = -1, miss = 0;
  source.forEach((_, out) => {
    const rest = (list) => list.filter((__, i) => i !== out);
    const off = misses(fitRigid(rest(source), rest(target)), source, target);
    const left = rms(rest(off));
    if (left < best) [best, bad, miss] = [left, out, off[out]];
  });
  return miss > BAD_METRES && miss > BAD_RATIO * best ? bad : -1;
}

function isOnLine(points) {
  const middle = mean(points);
  const spread = [0, 1, 2].map((j) => [0, 1, 2].map((k) =>
    points.reduce((sum, p) => sum + (p[j] - middle[j]) * (p[k] - middle[k]), 0)));
  const { values } = eigen(spread);
  return Math.sqrt(Math.max(values[1], 0)) <= THIN * Math.sqrt(Math.max(values[0], 0));
}

// What the pairs say so far. Lengths in metres; null while there are fewer than three.
export function fitPairs(source, target) {
  if (source.length < 3) return null;
  const fit = fitRigid(source, target);
  const residuals = misses(fit, source, target);
  const bad = badOf(source, target);
  const kept = (list) => list.filter((_, i) => i !== bad);
  const size = (list) => rms(kept(list).map((p) => Math.hypot(...minus(p, mean(kept(list))))));
  return {
    ...fit, residuals, bad, rms: rms(residuals), scale: size(target) / size(source),
    isOnLine: isOnLine(source) || isOnLine(target),
  };
}

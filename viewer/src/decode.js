// The points that a report carries: base64 of a zlib stream of byte planes (see report/payload.py).

import { CLASS_COUNT, REASON_COUNT, classSlot } from "./colours.js";

async function inflated(element) {
  const text = element.textContent;
  const bytes = Uint8Array.fromBase64
    ? Uint8Array.fromBase64(text)
    : Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  element.remove();
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Class and reason of removal in one byte, as the shader takes them apart.
export const packed = (code, reason) => classSlot(code) + CLASS_COUNT * Math.min(reason, REASON_COUNT - 1);

// A signed distance (metres) as a byte: 127 is zero, 255 none.
export function residualCode(metres, most) {
  if (!Number.isFinite(metres)) return 255;
  return 127 + Math.round(Math.sign(metres) * 127 * Math.sqrt(Math.min(Math.abs(metres) / most, 1)));
}

export async function decode(cloud) {
  const raw = await inflated(document.getElementById(cloud.element));
  const n = cloud.points;
  let offset = 0;
  const plane = () => raw.subarray(offset, (offset += n));
  const position = new Float32Array(3 * n);
  for (let axis = 0; axis < 3; axis++) {
    const low = plane(), high = plane();
    let i = 0;
    for (const block of cloud.blocks) {
      const first = block[axis] * 65536;
      for (const end = i + block[3]; i < end; i++) {
        position[3 * i + axis] = (first + low[i] + 256 * high[i]) * cloud.step_m;
      }
    }
  }
  const colour = new Uint8Array(3 * n), info = new Uint8Array(4 * n);
  const fill = (out, index, values, width = 3) => {
    for (let i = 0; i < n; i++) out[width * i + index] = values[i];
  };
  fill(info, 3, plane(), 4);
  if (cloud.colour === "rgb") {
    for (const index of [0, 1, 2]) fill(colour, index, plane());
  } else if (cloud.colour === "intensity") {
    const grey = plane();
    for (const index of [0, 1, 2]) fill(colour, index, grey);
  } else colour.fill(150);
  fill(info, 0, new Uint8Array(n).fill(cloud.source), 4);
  fill(info, 1, cloud.has_residual ? plane() : new Uint8Array(n).fill(255), 4);
  const classes = cloud.has_class ? plane() : null, reasons = cloud.has_reason ? plane() : null;
  for (let i = 0; i < n; i++) info[4 * i + 2] = packed(classes?.[i] ?? 0, reasons?.[i] ?? 0);
  return { position, colour, info, spacing: cloud.spacing_m };
}

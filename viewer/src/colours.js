// Colours that every common colour vision tells apart. Stops of viridis and plasma (matplotlib);
// the two-sided ramp runs from blue over pale grey to red-brown, dark at both ends.

export const HEIGHT = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
export const RESIDUAL = ["#0d0887", "#6a00a8", "#b12a90", "#e16462", "#fca636", "#f0f921"];
export const SIGNED = ["#08306b", "#2f80bd", "#b3cbd9", "#dcc3ad", "#cf6237", "#7a1a08"];
export const NONE = "#8c8c8c";

// ASPRS classes, and the one of our clutter filter: what may have to go stands out, the rest is quiet.
const UNKNOWN = "#9a9a96";
export const CLASSES = [
  [0, "never classified", UNKNOWN],
  [1, "unclassified", UNKNOWN],
  [2, "ground", "#9c7a4d"],
  [3, "low vegetation", "#a8c686"],
  [4, "medium vegetation", "#6fae5f"],
  [5, "high vegetation", "#2f7d4f"],
  [6, "building", "#7aa6cf"],
  [7, "noise", "#cc2f7b"],
  [9, "water", "#2266cc"],
  [64, "clutter: a person, vehicle, pole or wire", "#e69f00"],
];
// Classes are drawn by their place in the list; the last place is for all that are not in it.
export const CLASS_COUNT = 16;
const OTHER = CLASS_COUNT - 1;

const SLOTS = new Uint8Array(256).fill(OTHER);
CLASSES.forEach(([code], slot) => (SLOTS[code] = slot));
export const classSlot = (code) => SLOTS[code];

export const classColours = () =>
  Array.from({ length: CLASS_COUNT }, (_, slot) => CLASSES[slot]?.[2] ?? UNKNOWN);

// Why a point was taken out (dougong_reason); Okabe and Ito (2008) on the quiet grey of what stayed.
export const REASONS = [
  [0, "kept", "#b4b5b0"],
  [1, "decimated", "#8b8d8a"],
  [2, "low outlier", "#0072b2"],
  [3, "curvature-weighted", "#d55e00"],
  [4, "statistical", "#cc79a7"],
  [5, "radius", "#009e73"],
  [6, "cropped", "#56b4e9"],
  [7, "cloth", "#e6c200"],
  [8, "clutter", "#7b3294"],
];
export const REASON_COUNT = 16;

export const reasonColours = () =>
  Array.from({ length: REASON_COUNT }, (_, code) => REASONS[code]?.[2] ?? UNKNOWN);

export const hex = (rgb) => "#" + rgb.map((v) => v.toString(16).padStart(2, "0")).join("");

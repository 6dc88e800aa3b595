// Colours that every common colour vision tells apart. Stops of viridis and plasma (matplotlib);
// the two-sided ramp runs from blue over pale grey to red-brown, dark at both ends.

export const HEIGHT = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
export const RESIDUAL = ["#0d0887", "#6a00a8", "#b12a90", "#e16462", "#fca636", "#f0f921"];
export const SIGNED = ["#08306b", "#2f80bd", "#b3cbd9", "#dcc3ad", "#cf6237", "#7a1a08"];
export const NONE = "#8c8c8c";

// ASPRS classes 0..18: noise stands out, the rest stays quiet.
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
];
export const CLASS_COUNT = 20;

export function classColours() {
  const colours = Array.from({ length: CLASS_COUNT }, () => UNKNOWN);
  for (const [code, , colour] of CLASSES) colours[code] = colour;
  return colours;
}

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
];

export const reasonColours = () => REASONS.map(([, , colour]) => colour);

export const hex = (rgb) => "#" + rgb.map((v) => v.toString(16).padStart(2, "0")).join("");

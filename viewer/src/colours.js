// Colours that every common colour vision tells apart. Stops of viridis and plasma (matplotlib).

export const HEIGHT = ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725"];
export const RESIDUAL = ["#0d0887", "#6a00a8", "#b12a90", "#e16462", "#fca636", "#f0f921"];

// ASPRS classes 0..18 and "removed": noise and removed points stand out, the rest stays quiet.
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

export const hex = (rgb) => "#" + rgb.map((v) => v.toString(16).padStart(2, "0")).join("");

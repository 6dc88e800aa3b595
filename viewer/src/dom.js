// Small helpers. Text from the data only ever enters the page as text, never as markup.

export function h(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value != null) node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child != null));
  return node;
}

export const metres = (value, unit = "m", digits = 3) => `${value.toFixed(digits)} ${unit}`;

export const signed = (value, digits = 3) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

export function roundLength(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((step) => step * power).find((step) => step <= value * (1 + 1e-9));
}

export function lengthText(value) {
  if (value >= 1) return `${+value.toPrecision(3)} m`;
  return value >= 0.01 ? `${+(value * 100).toPrecision(3)} cm` : `${+(value * 1000).toPrecision(3)} mm`;
}

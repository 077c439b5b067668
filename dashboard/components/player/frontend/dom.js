// Small helpers to build elements.

/** Make an element; `on...` are listeners, `style` an object, the rest attributes. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(element.style, value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** The shape of a level: told apart without colour. */
export function shape(css) {
  return make("i", { class: `shape ${css}`, "aria-hidden": "true" });
}

/** Fill the gaps of a sentence: "{n} lifts". */
export function fill(text, values) {
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name]);
}

export const seconds = (time, digits = 2) => `${time.toFixed(digits)} s`;

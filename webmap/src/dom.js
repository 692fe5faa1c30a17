// Elements are made here, and text is only ever text: names come from strangers' files.
const SVG = 'http://www.w3.org/2000/svg';

/** The element of the page with this id. */
export const byId = (id) => document.getElementById(id);

/** A new element with properties and children; strings become text. */
export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

/** A new element of SVG with attributes, which must not be a stranger's, and text. */
export function drawn(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  if (text !== undefined) made.textContent = text;
  return made;
}

/** Tell something that keeps the map from being what it should; each once. */
export function notice(words) {
  const box = byId('notices');
  if ([...box.children].every((one) => one.textContent !== words)) box.append(element('p', { textContent: words }));
}

/** A number with a real minus sign, so many decimals. */
export const number = (value, decimals) => value.toFixed(decimals).replace('-', '−');

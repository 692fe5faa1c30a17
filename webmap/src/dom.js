// Creation of elements. Text is inserted as text only, never as markup, because names come from untrusted files.
const SVG = 'http://www.w3.org/2000/svg';

/** Return the element with an id. */
export const byId = (id) => document.getElementById(id);

/** Create an element with properties and children; strings become text nodes. */
export function element(name, properties = {}, ...children) {
  const created = Object.assign(document.createElement(name), properties);
  created.append(...children);
  return created;
}

/** Create an SVG element with text and attributes; attributes must not come from untrusted files. */
export function drawn(name, attributes, text) {
  const created = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) created.setAttribute(key, String(value));
  if (text !== undefined) created.textContent = text;
  return created;
}

/** Show a problem of the map to the user; a message that is already displayed is not repeated. */
export function notice(message) {
  const box = byId('notices');
  if ([...box.children].every((child) => child.textContent !== message)) box.append(element('p', { textContent: message }));
}

/** Save a file from the page. */
export function save(blob, name) {
  const link = element('a', { download: name, href: URL.createObjectURL(blob) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** Format a number with a given number of decimals and a true minus sign. */
export const number = (value, decimals) => value.toFixed(decimals).replace('-', '−');

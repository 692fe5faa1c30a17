// What is shown, in the address after '#': a link to it. Whatever stands there is checked before it is used.
const numbers = (text, count) => {
  const found = (text ?? '').split(',').map(Number);
  return text && found.length === count && found.every(Number.isFinite) ? found : null;
};

/** What an address asks for; null for what it does not ask for, or not in numbers. */
export function read(hash) {
  const asked = new URLSearchParams(hash.slice(1));
  const line = numbers(asked.get('line'), 4);
  const view = numbers(asked.get('view'), 3);
  return {
    image: asked.get('image'),
    layer: asked.get('layer'),
    colours: asked.get('colours'),
    stretch: numbers(asked.get('stretch'), 2),
    over: asked.has('over') ? asked.get('over').split(',') : null,
    view: view && view[2] > 0 ? view : null,
    line: line && [line.slice(0, 2), line.slice(2)],
  };
}

/** Put what is shown into the address, and tell the window around the map; the browser's history does not grow. */
export function write({ image, layer, colours, stretch, over, view, line }, decimals) {
  const fixed = (values, more = 0) => values.map((value) => Number(value.toFixed(decimals + more))).join(',');
  const asked = new URLSearchParams({ image, layer, colours, stretch: stretch.join(','), over: over.join(',') });
  asked.set('view', `${fixed(view.slice(0, 2))},${Number(view[2].toPrecision(4))}`);
  if (line) asked.set('line', fixed(line.flat()));
  history.replaceState(null, '', `#${asked.toString().replaceAll('%2C', ',').replaceAll('%2F', '/')}`);
  const said = { hash: location.hash, title: document.title };
  if (parent !== window) parent.postMessage(said, `${location.protocol}//localhost:${location.port}`);
}

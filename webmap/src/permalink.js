// Permalink: state of the page in the fragment of its URL. The fragment is validated before it is used.
const numbers = (text, count) => {
  const values = (text ?? '').split(',').map(Number);
  return text && values.length === count && values.every(Number.isFinite) ? values : null;
};

/** Parse a fragment; missing and invalid values are null. */
export function read(hash) {
  const parameters = new URLSearchParams(hash.slice(1));
  const line = numbers(parameters.get('line'), 4);
  const view = numbers(parameters.get('view'), 3);
  return {
    image: parameters.get('image'),
    layer: parameters.get('layer'),
    colours: parameters.get('colours'),
    stretch: numbers(parameters.get('stretch'), 2),
    over: parameters.has('over') ? parameters.get('over').split(',') : null,
    view: view && view[2] > 0 ? view : null,
    line: line && [line.slice(0, 2), line.slice(2)],
    right: parameters.get('right'),
    rightLayer: parameters.get('right_layer'),
    divider: numbers(parameters.get('divider'), 1)?.[0] ?? null,
  };
}

/** Write the state to the URL, without a new entry in the history, and post the state to the window around the map. */
export function write({ image, layer, colours, stretch, over, view, line, right }, decimals) {
  const fixed = (values, more = 0) => values.map((value) => Number(value.toFixed(decimals + more))).join(',');
  const parameters = new URLSearchParams({ image, layer, colours, stretch: stretch.join(','), over: over.join(',') });
  parameters.set('view', `${fixed(view.slice(0, 2))},${Number(view[2].toPrecision(4))}`);
  if (line) parameters.set('line', fixed(line.flat()));
  for (const [name, value] of Object.entries(right ?? {})) parameters.set(name, value);
  history.replaceState(null, '', `#${parameters.toString().replaceAll('%2C', ',').replaceAll('%2F', '/')}`);
  const state = { hash: location.hash, title: document.title };
  if (parent !== window) parent.postMessage(state, `${location.protocol}//localhost:${location.port}`);
}

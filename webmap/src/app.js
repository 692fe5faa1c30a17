// The page: connects the panel with the map, the divider, the readout, the cross-section, the target list, the exports
// and the permalink.
import 'ol/ol.css';
import './app.css';
import { Chart, canDraw } from './chart.js';
import { MASK, MASK_NAMES, RAMPS, drawRamp, rampOf } from './colours.js';
import { byId, element, notice, number, save } from './dom.js';
import * as permalink from './permalink.js';
import { picture } from './picture.js';
import { Places } from './places.js';
import { Raster } from './raster.js';
import { Readout } from './readout.js';
import { Section } from './section.js';
import { Swipe } from './swipe.js';
import { Targets } from './targets.js';

const FORMAT = 2;
const OVER = { mask: 'mask: shadow and layover', tracks: 'tracks', footprints: 'footprints', targets: 'targets' };
const BEYOND = 0.5; // travel of the sliders beyond the value range of the layer, as a fraction of that range

class Page {
  constructor(data, tiles) {
    this.data = data;
    this.tiles = tiles;
    this.right = null; // image and layer right of the divider
    this.rasters = new Map();
    this.places = new Places(data);
    this.chart = new Chart('map', this.places);
    this.readout = new Readout(this.chart, this.places, () => this.sides(), data.classes);
    this.section = new Section(this.chart, this.places, () => this.raster, () => this.remember());
    this.swipe = new Swipe((share) => this.chart.divide(share), () => this.remember());
    this.targets = new Targets(data.places, this.chart, this.places, () => (this.layer.unit === 'dB' ? this.raster : null));
    data.notes.forEach(notice);
    this.describe();
    this.fill();
    this.restore(permalink.read(location.hash));
    this.listen();
    if (data.coverage_url) this.chart.cover(data.coverage_url).then(() => this.outside(), (error) => notice(error.message));
    else this.untracked();
  }

  /** Disable tracks and footprints, which are not exported as GeoJSON for a local frame. */
  untracked() {
    for (const control of [this.boxes.tracks, this.boxes.footprints, byId('fit-tracks')]) control.disabled = true;
  }

  /** Fill in the texts about the campaign that do not change. */
  describe() {
    const { campaign, crs } = this.data;
    document.title = `${campaign} · apertura map`;
    byId('campaign').textContent = campaign;
    this.crs = crs.local ? 'local frame, not georeferenced' : `${crs.name} · ${crs.code}`;
    byId('crs').textContent = this.crs;
    byId('kmz').disabled = crs.local;
    if (this.tiles) {
      this.chart.background(this.tiles);
      byId('attribution').textContent = this.tiles.attribution;
      byId('fading').hidden = false;
    }
    const right = this.places.convergence();
    const north =
      right === null ? 'up is the local y axis' : `up is grid north; true north is ${number(Math.abs(right), 2)}° to the ${right < 0 ? 'left' : 'right'}`;
    byId('north').lastElementChild.textContent = right === null ? 'y' : 'grid N';
    byId('north').title = north;
    byId('north').setAttribute('aria-label', north);
    const entries = Object.entries(MASK).map(([value, colour]) => {
      const swatch = element('span', { className: 'swatch' });
      swatch.style.background = colour;
      return element('li', {}, swatch, this.data.classes[value]);
    });
    byId('mask-legend').append(...entries);
  }

  /** Fill the controls of the panel. */
  fill() {
    this.list();
    byId('colours').append(...Object.keys(RAMPS).map((name) => element('option', { value: name, textContent: name })));
    this.boxes = {};
    this.overlays = {};
    for (const [name, label] of Object.entries(OVER)) {
      const box = element('input', { type: 'checkbox', checked: name !== 'mask' });
      this.boxes[name] = box;
      this.overlays[name] = element('span', { textContent: ` ${label}` });
      byId('overlays').append(element('label', {}, box, this.overlays[name]));
      box.addEventListener('change', () => this.over());
    }
  }

  /** Fill the list of images. */
  list() {
    const flights = new Map();
    for (const { flight, image } of this.data.images) {
      if (!flights.has(flight)) flights.set(flight, element('optgroup', { label: flight }));
      flights.get(flight).append(element('option', { value: `${flight}/${image}`, textContent: `${flight} · ${image}` }));
    }
    byId('image').replaceChildren(...flights.values());
    const copies = [...flights.values()].map((group) => group.cloneNode(true));
    byId('right').replaceChildren(element('option', { value: '', textContent: 'none' }), ...copies);
  }

  listen() {
    byId('image').addEventListener('change', () => this.choose(byId('image').value, this.layer.file));
    byId('layer').addEventListener('change', () => this.choose(byId('image').value, byId('layer').value));
    byId('right').addEventListener('change', () => this.compare(byId('right').value, this.right?.layer.file ?? this.layer.file));
    byId('right-layer').addEventListener('change', () => this.compare(byId('right').value, byId('right-layer').value));
    byId('opacity').addEventListener('input', () => this.chart.fade(byId('opacity').valueAsNumber));
    byId('png').addEventListener('click', () => this.savePicture().catch((error) => notice(error.message)));
    byId('kmz').addEventListener('click', () => {
      byId('kmz').disabled = true; // until the server has made the file
      this.saveOverlay().catch((error) => notice(error.message)).finally(() => (byId('kmz').disabled = false));
    });
    byId('colours').addEventListener('change', () => this.show());
    byId('reset').addEventListener('click', () => this.stretch(this.layer.low, this.layer.high));
    for (const name of ['low', 'high'])
      byId(name).addEventListener('input', () => this.stretch(byId('low').valueAsNumber, byId('high').valueAsNumber, name));
    byId('skip').addEventListener('click', () => byId('map').focus());
    byId('fit-scene').addEventListener('click', () => this.chart.fit());
    byId('fit-tracks').addEventListener('click', () => this.chart.fit(true));
    byId('toggle').addEventListener('click', () => {
      const open = document.body.classList.toggle('closed');
      byId('toggle').setAttribute('aria-expanded', String(!open));
      this.chart.map.updateSize();
    });
    this.chart.map.on('moveend', () => {
      this.remember();
      this.outside();
    });
    addEventListener('hashchange', () => this.restore(permalink.read(location.hash)));
  }

  /** Show the state given by a permalink, as far as its images and layers exist in the campaign. */
  restore(state) {
    if (state.over) for (const [name, box] of Object.entries(this.boxes)) box.checked = state.over.includes(name);
    if (state.view) {
      this.chart.view.setCenter(state.view.slice(0, 2));
      this.chart.view.setResolution(state.view[2]);
    }
    this.choose(state.image, state.layer, state);
    this.compare(state.right, state.rightLayer);
    if (state.divider !== null) this.swipe.set(state.divider);
    this.section.set(state.line);
  }

  /** Select an image and one of its layers by name; for unknown names, select the first image or layer. */
  choose(image, file, { stretch = null, colours = null } = {}) {
    this.image = this.data.images.find((entry) => `${entry.flight}/${entry.image}` === image) ?? this.data.images[0];
    const before = this.layer;
    this.layer = fillLayers(byId('layer'), this.image, file);
    byId('image').value = `${this.image.flight}/${this.image.image}`;
    byId('title').textContent = quantity(this.layer);
    if (Object.hasOwn(RAMPS, colours ?? '')) byId('colours').value = colours;
    else if (before?.kind !== this.layer.kind) byId('colours').value = rampOf(this.layer);
    this.limits(...(stretch ?? [this.layer.low, this.layer.high]));
    showQuality(this.image, byId('verdict'), byId('flags'));
    this.show();
    this.over();
    this.targets.list(byId('image').value);
    this.section.refresh();
  }

  /** Select the image right of the divider and one of its layers; for an unknown image, remove the divider. */
  compare(image, file) {
    const found = this.data.images.find((entry) => `${entry.flight}/${entry.image}` === image);
    byId('comparison').hidden = !found;
    byId('right').value = found ? image : '';
    this.right = found ? { image: found, layer: fillLayers(byId('right-layer'), found, file) } : null;
    if (found) {
      byId('right-title').textContent = quantity(this.right.layer);
      showQuality(found, byId('right-verdict'), byId('right-flags'));
    }
    this.showRight();
    this.over();
  }

  /** Set the colour scale of the right image: that of the left image, if both show the same quantity. */
  scaleRight() {
    const { layer } = this.right;
    const [left, right] = [this.layer, layer].map((each) => quantity(each).replace(/\d+/g, '')); // sums of any number of pairs
    const common = left === right;
    const colours = common ? byId('colours').value : rampOf(layer);
    Object.assign(this.right, { colours, ...(common ? { low: this.low, high: this.high } : { low: layer.low, high: layer.high }) });
    drawRamp(byId('right-ramp'), colours);
    for (const name of ['low', 'high']) byId(`right-ramp-${name}`).textContent = common ? byId(`ramp-${name}`).textContent : `${number(layer[name], 1)} ${layer.unit}`;
    this.chart.stretch('right', this.right.low, this.right.high);
  }

  /** Show the image right of the divider, if one is selected. */
  showRight() {
    if (this.right) this.scaleRight();
    const { layer, colours, low, high } = this.right ?? { layer: null };
    this.chart.show('right', layer, colours, low, high);
    this.swipe.show(this.right && [caption(this.image, this.layer), caption(this.right.image, layer)]);
    this.readout.refresh();
    this.remember();
  }

  /** Return label, raster and mask of each displayed image. */
  sides() {
    const shown = [{ label: this.right ? 'left' : '', raster: this.raster, mask: this.maskOf(this.image) }];
    if (this.right) shown.push({ label: 'right', raster: this.opened(this.right.layer), mask: this.maskOf(this.right.image) });
    return shown;
  }

  maskOf(image) {
    const layer = this.boxes.mask.checked && image.layers.find(({ kind }) => kind === 'classes');
    return layer ? this.opened(layer) : null;
  }

  /** Save the view as PNG, with scale, north, colour bars, CRS, and verdict and flags of each displayed image. */
  async savePicture() {
    const left = { image: this.image, layer: this.layer, colours: byId('colours').value };
    const shown = this.right ? [left, this.right] : [left];
    const columns = shown.map(({ image, layer, colours }, index) => {
      const [low, high] = ['low', 'high'].map((end) => byId(`${index ? 'right-' : ''}ramp-${end}`).textContent);
      const side = this.right ? ['left: ', 'right: '][index] : '';
      return { colours, low, high, quantity: `${side}${image.flight} · ${image.image} · ${quantity(layer)}`, lines: qualityLines(image) };
    });
    const classes = Object.entries(MASK_NAMES).map(([value, colour]) => `${this.data.classes[value]} ${colour}`);
    const notes = [`${this.crs} · ${byId('north').title}`, !byId('mask-legend').hidden && `Mask: ${classes.join(', ')}`, this.tiles && `Background: ${this.tiles.attribution}`];
    await new Promise((done) => {
      this.chart.map.once('rendercomplete', done); // with all tiles of the view
      this.chart.map.render();
    });
    const canvas = picture(this.chart, {
      title: `${this.data.campaign} · ${shown.map(({ image }) => `${image.flight} · ${image.image}`).join(' | ')}`,
      columns,
      north: byId('north').lastElementChild.textContent,
      notes: notes.filter(Boolean).map((note) => ['note', note]),
      divider: this.right ? this.swipe.share : null,
    });
    const blob = await new Promise((done) => canvas.toBlob(done, 'image/png'));
    save(blob, `${shown.map(({ image, layer }) => fileName(image, layer)).join('_and_')}.png`);
  }

  /** Save the KMZ of the image, which the server makes from the raster at full resolution with the displayed colours. */
  async saveOverlay() {
    const scale = new URLSearchParams({ low: this.low, high: this.high, colours: byId('colours').value });
    const answer = await fetch(`${this.layer.url.replace('.tif?', '.kmz?')}&${scale}`);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    save(await answer.blob(), `${fileName(this.image, this.layer)}.kmz`);
  }

  limits(low, high) {
    const range = this.layer.high - this.layer.low || 1;
    const step = Number((range / 200).toPrecision(1));
    for (const name of ['low', 'high'])
      Object.assign(byId(name), { step, min: this.layer.low - BEYOND * range, max: this.layer.high + BEYOND * range });
    this.stretch(low, high);
  }

  /** Set both ends of the colour scale; if the ends would cross, the end that was not moved is adjusted. */
  stretch(low, high, moved = 'low') {
    const gap = Number(byId('low').step) || 1e-6;
    this.low = moved === 'high' ? Math.min(low, high - gap) : low;
    this.high = moved === 'high' ? high : Math.max(high, low + gap);
    const decimals = Math.max(0, 1 - Math.floor(Math.log10(this.high - this.low)));
    for (const name of ['low', 'high']) {
      byId(name).value = this[name];
      const text = `${number(this[name], Math.min(4, decimals))} ${this.layer.unit}`;
      for (const id of [`${name}-value`, `ramp-${name}`]) byId(id).textContent = text;
      byId(name).setAttribute('aria-valuetext', text);
    }
    this.chart.stretch('left', this.low, this.high);
    if (this.right) this.scaleRight();
    this.remember();
  }

  show() {
    this.raster = this.opened(this.layer);
    const colours = byId('colours').value;
    drawRamp(byId('ramp'), colours);
    this.chart.show('left', this.layer, colours, this.low, this.high);
    this.showRight();
  }

  over() {
    const [left, right] = [this.image, this.right?.image].map((image) => image?.layers.find(({ kind }) => kind === 'classes') ?? null);
    const masked = this.boxes.mask.checked && Boolean(left || right);
    this.boxes.mask.disabled = !(left || right);
    this.chart.mask('left', masked ? left : null);
    this.chart.mask('right', masked ? right : null);
    byId('mask-legend').hidden = !masked;
    for (const name of ['tracks', 'footprints', 'targets']) this.chart[name].setVisible(this.boxes[name].checked);
    this.readout.refresh();
    this.remember();
  }

  /** Mark overlays that are completely outside the view. */
  outside() {
    for (const name of ['tracks', 'footprints'])
      this.overlays[name].textContent = ` ${OVER[name]}${this.chart.isOutside(name) ? ' (outside the view)' : ''}`;
  }

  /** Show a new document; the selection and a colour scale that the user changed are kept. */
  update(data) {
    const moved = this.low !== this.layer.low || this.high !== this.layer.high;
    const listed = this.data.images.map(({ flight, image }) => `${flight}/${image}`);
    this.data = data;
    this.rasters.clear();
    this.targets.all = data.places;
    if (data.images.some(({ flight, image }) => !listed.includes(`${flight}/${image}`))) this.list();
    const colours = byId('colours').value;
    const right = this.right && [`${this.right.image.flight}/${this.right.image.image}`, this.right.layer.file];
    this.choose(`${this.image.flight}/${this.image.image}`, this.layer.file, { stretch: moved ? [this.low, this.high] : null, colours });
    if (right) this.compare(...right);
  }

  /** Reload the document periodically during a flight. */
  async follow() {
    let before = JSON.stringify(this.data);
    while (this.data.again_s) {
      await new Promise((done) => setTimeout(done, 1000 * this.data.again_s));
      const data = await read().catch(() => this.data); // if not readable now, retry after the next interval
      const now = JSON.stringify(data);
      if (now !== before) this.update(data);
      before = now;
    }
  }

  opened(layer) {
    if (!this.rasters.has(layer.url)) this.rasters.set(layer.url, new Raster(layer, this.places));
    return this.rasters.get(layer.url);
  }

  remember() {
    if (!this.image || !this.section) return;
    const right = this.right && { right: `${this.right.image.flight}/${this.right.image.image}`, right_layer: this.right.layer.file, divider: this.swipe.share.toFixed(3) };
    const { view } = this.chart;
    permalink.write(
      {
        image: `${this.image.flight}/${this.image.image}`,
        layer: this.layer.file,
        colours: byId('colours').value,
        stretch: [this.low, this.high].map((value) => Number(value.toPrecision(5))),
        over: Object.keys(OVER).filter((name) => this.boxes[name].checked),
        view: [...view.getCenter(), view.getResolution()],
        line: this.section.ends,
        right,
      },
      this.places.decimals,
    );
  }
}

const caption = (image, layer) => `${image.flight} · ${image.image} · ${layerName(layer)}`;
const fileName = ({ flight, image }, { file }) => `${flight}_${image}_${file.replace(/\.tif$/, '')}`;
const layerName = ({ file }) => file.replace(/\.tif$/, '').replaceAll('_', ' ').replace(/ db$/, ', dB');
const quantity = ({ title, unit }) => `${title}${unit ? `, ${unit}` : ''}`;

/** Fill a list with the layers of an image; select and return a layer by name, or the first. */
function fillLayers(list, image, file) {
  const layers = image.layers.filter((layer) => layer.kind !== 'classes');
  const chosen = layers.find((layer) => layer.file === file) ?? layers[0];
  list.replaceChildren(...layers.map((layer) => element('option', { value: layer.file, textContent: layerName(layer) })));
  list.value = chosen.file;
  return chosen;
}

function verdictOf({ verdict, reason, error_db: error }) {
  return `${verdict}: ${reason}${error === null ? '' : `; numerical error below ${number(error, 1)} dB`}`;
}

/** Show verdict, numerical error and flags of an image. */
function showQuality(image, verdict, list) {
  verdict.textContent = verdictOf(image);
  const raised = Object.entries(image.flags).flatMap(([name, explanation]) => [
    element('dt', { textContent: name }),
    element('dd', { textContent: explanation }),
  ]);
  list.replaceChildren(...(raised.length ? raised : [element('dt', { className: 'none', textContent: 'no flags raised' })]));
}

/** Return verdict, flags, time of acquisition and licence of an image as lines of an exported picture. */
function qualityLines(image) {
  const flags = Object.entries(image.flags).flatMap(([name, explanation]) => [['flag', name], ['text', explanation]]);
  const lines = [['text', verdictOf(image)], ...(flags.length ? flags : [['text', 'no flags raised']])];
  if (image.acquired.length) lines.push(['note', `acquired ${image.acquired.join(' to ')}`]);
  if (image.licence) lines.push(['note', `licence ${image.licence}`]);
  return lines;
}

async function read() {
  const answer = await fetch('map.json');
  if (!answer.ok) throw new Error(`map.json: ${(await answer.text()).trim()}`);
  const data = await answer.json();
  if (data.format !== FORMAT) throw new Error('the format version of map.json differs from that of this page: run the workflow again');
  return data;
}

async function start() {
  if (!canDraw()) notice('This browser has no WebGL. Therefore images are not displayed, but values, targets and tracks are available.');
  const tiles = await fetch('tiles.json').then((answer) => answer.json());
  const page = new Page(await read(), tiles);
  page.follow().catch((error) => notice(error.message));
  page.chart.map.on('rendercomplete', () => {
    if (page.chart.drawn) document.documentElement.setAttribute('data-drawn', '');
  });
}

start().catch((error) => notice(`The map cannot be displayed: ${error.message}`));

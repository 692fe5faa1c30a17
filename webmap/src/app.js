// The page: connects the panel with the map, the readout, the cross-section, the target list and the permalink.
import 'ol/ol.css';
import './app.css';
import { Chart, canDraw } from './chart.js';
import { MASK, RAMPS, drawRamp } from './colours.js';
import { byId, element, notice, number } from './dom.js';
import * as permalink from './permalink.js';
import { Places } from './places.js';
import { Raster } from './raster.js';
import { Readout } from './readout.js';
import { Section } from './section.js';
import { Targets } from './targets.js';

const FORMAT = 1;
const OVER = { mask: 'mask: shadow and layover', tracks: 'tracks', footprints: 'footprints', targets: 'targets' };
const BEYOND = 0.5; // travel of the sliders beyond the value range of the layer, as a fraction of that range

class Page {
  constructor(data) {
    this.data = data;
    this.rasters = new Map();
    this.places = new Places(data);
    this.chart = new Chart('map', this.places);
    this.readout = new Readout(this.chart, this.places, () => this.raster, () => this.maskRaster, data.classes);
    this.section = new Section(this.chart, this.places, () => this.raster, () => this.remember());
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
    byId('crs').textContent = crs.local ? 'local frame, not georeferenced' : `${crs.name} · ${crs.code}`;
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
  }

  listen() {
    byId('image').addEventListener('change', () => this.choose(byId('image').value, this.layer.file));
    byId('layer').addEventListener('change', () => this.choose(byId('image').value, byId('layer').value));
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
    this.section.set(state.line);
  }

  /** Select an image and one of its layers by name; for unknown names, select the first image or layer. */
  choose(image, file, { stretch = null, colours = null } = {}) {
    this.image = this.data.images.find((entry) => `${entry.flight}/${entry.image}` === image) ?? this.data.images[0];
    const layers = this.image.layers.filter((layer) => layer.kind !== 'classes');
    const before = this.layer;
    this.layer = layers.find((layer) => layer.file === file) ?? layers[0];
    byId('image').value = `${this.image.flight}/${this.image.image}`;
    byId('layer').replaceChildren(...layers.map((layer) => element('option', { value: layer.file, textContent: layer.file.replace(/\.tif$/, '').replaceAll('_', ' ').replace(/ db$/, ', dB') })));
    byId('layer').value = this.layer.file;
    byId('title').textContent = `${this.layer.title}${this.layer.unit ? `, ${this.layer.unit}` : ''}`;
    if (Object.hasOwn(RAMPS, colours ?? '')) byId('colours').value = colours;
    else if (before?.kind !== this.layer.kind) byId('colours').value = this.layer.kind === 'image' ? 'grey' : 'viridis';
    this.maskLayer = this.image.layers.find((layer) => layer.kind === 'classes') ?? null;
    this.boxes.mask.disabled = !this.maskLayer;
    this.limits(...(stretch ?? [this.layer.low, this.layer.high]));
    this.showQuality();
    this.show();
    this.over();
    this.targets.list(byId('image').value);
    this.section.refresh();
  }

  /** Show verdict, numerical error and flags of the image. */
  showQuality() {
    const { verdict, reason, error_db: error, flags } = this.image;
    const bound = error === null ? '' : `; numerical error below ${number(error, 1)} dB`;
    byId('verdict').textContent = `${verdict}: ${reason}${bound}`;
    const raised = Object.entries(flags).flatMap(([name, explanation]) => [
      element('dt', { textContent: name }),
      element('dd', { textContent: explanation }),
    ]);
    byId('flags').replaceChildren(...(raised.length ? raised : [element('dt', { className: 'none', textContent: 'no flags raised' })]));
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
    this.chart.stretch(this.low, this.high);
    this.remember();
  }

  show() {
    this.raster = this.opened(this.layer);
    const colours = byId('colours').value;
    drawRamp(byId('ramp'), colours);
    this.chart.show(this.layer, colours, this.low, this.high);
    this.readout.refresh();
    this.remember();
  }

  over() {
    const masked = this.boxes.mask.checked && this.maskLayer;
    this.maskRaster = masked ? this.opened(this.maskLayer) : null;
    this.chart.mask(masked ? this.maskLayer : null);
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
    this.choose(`${this.image.flight}/${this.image.image}`, this.layer.file, { stretch: moved ? [this.low, this.high] : null, colours });
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
      },
      this.places.decimals,
    );
  }
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
  const page = new Page(await read());
  page.follow().catch((error) => notice(error.message));
  page.chart.map.on('rendercomplete', () => {
    if (page.chart.drawn) document.documentElement.setAttribute('data-drawn', '');
  });
}

start().catch((error) => notice(`The map cannot be displayed: ${error.message}`));

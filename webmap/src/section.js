// Cross-section tool: a line on the map, with a plot of the values along the line and a CSV export.
import Draw from 'ol/interaction/Draw.js';
import { byId, element, number, save } from './dom.js';
import { plot, width3dB } from './plot.js';

const NAMES = { earth: ['from E', 'from N', 'to E', 'to N'], local: ['from x', 'from y', 'to x', 'to y'] };
const HEIGHT = 190;

export class Section {
  /** `raster` is a function that returns the displayed raster; `changed` is called after a change of the line. */
  constructor(chart, places, raster, changed) {
    Object.assign(this, { chart, places, raster, changed, ends: null, request: 0 });
    this.inputs = NAMES[places.toGeographic ? 'earth' : 'local'].map((name) => {
      const input = element('input', { type: 'number', step: 'any' });
      input.addEventListener('change', () => this.typed());
      byId('ends').append(element('label', {}, `${name} `, input));
      return input;
    });
    byId('draw').addEventListener('click', () => this.draw());
    byId('clear').addEventListener('click', () => this.set(null));
    byId('csv').addEventListener('click', () => this.save());
    document.addEventListener('keydown', (event) => event.key === 'Escape' && this.stop());
    new ResizeObserver(() => this.plot()).observe(byId('stage'));
  }

  draw() {
    this.stop();
    this.tool = new Draw({ type: 'LineString', maxPoints: 2, source: undefined });
    this.tool.on('drawend', ({ feature }) => {
      const ends = feature.getGeometry().getCoordinates();
      setTimeout(() => this.stop()); // the tool must not be removed while its event is handled
      this.set(ends);
    });
    this.chart.map.addInteraction(this.tool);
    byId('draw').classList.add('active');
  }

  stop() {
    if (this.tool) this.chart.map.removeInteraction(this.tool);
    this.tool = null;
    byId('draw').classList.remove('active');
  }

  typed() {
    const values = this.inputs.map((input) => input.valueAsNumber);
    if (values.every(Number.isFinite)) this.set([values.slice(0, 2), values.slice(2)]);
  }

  /** Set the line by its end points [x, y]; null, or a line of length zero, removes it. */
  set(ends) {
    const valid = ends && Math.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]) > 0 ? ends : null;
    this.ends = valid;
    this.inputs.forEach((input, index) => {
      input.value = valid ? valid.flat()[index].toFixed(this.places.decimals) : '';
    });
    this.chart.drawLine(valid);
    this.changed();
    return this.refresh();
  }

  /** Read the values after a change of the line or the raster. */
  async refresh() {
    const request = ++this.request;
    this.samples = null;
    const raster = this.raster();
    let problem = '';
    if (this.ends && raster)
      try {
        const samples = await raster.along(...this.ends);
        if (request !== this.request) return;
        this.samples = samples;
        this.of = raster.layer;
      } catch (error) {
        problem = error.message;
      }
    if (request !== this.request) return;
    byId('section').hidden = !this.ends;
    byId('clear').disabled = !this.ends;
    byId('csv').disabled = !this.samples;
    byId('section-words').textContent = this.samples ? this.words() : problem;
    this.plot();
  }

  plot() {
    const box = byId('plot');
    box.replaceChildren();
    if (this.samples && box.clientWidth > 0) box.append(plot(this.samples, this.of.unit, box.clientWidth, HEIGHT));
  }

  words() {
    const best = this.samples.reduce((highest, sample) => (sample.value > highest.value ? sample : highest), { value: -Infinity });
    if (!Number.isFinite(best.value)) return 'no values along this line';
    const spacing = this.samples[1].distance;
    const parts = [`maximum ${number(best.value, 2)} ${this.of.unit} at ${number(best.distance, 3)} m`];
    const width = this.of.unit === 'dB' ? width3dB(this.samples) : null;
    if (width !== null) parts.push(`−3 dB width ${number(width, 3)} m`);
    const interpolation = this.of.unit === 'dB' ? 'bilinear in power' : 'nearest pixel';
    return `${parts.join(' · ')} · sample spacing ${number(spacing, 3)} m, ${interpolation}`;
  }

  save() {
    const geographic = this.places.toGeographic;
    const georeferenced = ['easting_m', 'northing_m', 'longitude_deg', 'latitude_deg'];
    const names = ['distance_m', ...(geographic ? georeferenced : ['x_m', 'y_m'])];
    const rows = this.samples.map(({ distance, place, value }) => {
      const degrees = geographic ? geographic([...place]).map((angle) => angle.toFixed(9)) : [];
      const metres = [distance, ...place].map((length) => length.toFixed(4));
      return [...metres, ...degrees, Number.isFinite(value) ? value.toFixed(4) : ''].join(',');
    });
    const unit = this.of.unit.toLowerCase().replace(/[^a-z0-9]/g, '') || 'value';
    const text = [`${[...names, `value_${unit}`].join(',')}`, ...rows].join('\n');
    save(new Blob([`${text}\n`], { type: 'text/csv' }), 'cross-section.csv');
  }
}

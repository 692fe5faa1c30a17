// The target list: where points are said to be, and where the image shown has its peak near them.
import { byId, element, number } from './dom.js';

const SOURCES = { truth: 'true place', stated: 'stated in the config', found: 'found in the image' };
const REACH_M = 0.3; // around a place, or so many pixels
const REACH_PX = 4;

export class Targets {
  /** `raster` gives the image in dB that peaks are looked for in, or null. */
  constructor(all, chart, places, raster) {
    Object.assign(this, { all, chart, places, raster });
  }

  /** List the targets that an image has: those known beforehand, and those found in it. */
  list(image) {
    const shown = this.all.filter((one) => one.image === null || one.image === image);
    this.chart.mark(shown);
    byId('targets-note').textContent = shown.length
      ? 'Choose one to see it, and the peak that the image has there.'
      : 'No points are known: the campaign has no truth.json and no reference points.';
    byId('targets').replaceChildren(...shown.map((one) => this.row(one)));
  }

  row(target) {
    const at = [target.x_m, target.y_m];
    const button = element('button', { type: 'button' }, element('strong', { textContent: target.name }));
    button.append(
      element('span', { textContent: SOURCES[target.source] ?? '' }),
      element('span', { className: 'place', textContent: this.places.words(at) }),
    );
    const peak = element('output', { className: 'peak' });
    button.addEventListener('click', () => {
      this.chart.zoomTo(at);
      this.measure(at, peak);
    });
    return element('li', {}, button, peak);
  }

  async measure(at, output) {
    const raster = this.raster();
    if (!raster) {
      output.textContent = 'choose a layer in dB to measure its peak';
      return;
    }
    const reach = Math.max(REACH_PX, Math.round(REACH_M / this.places.grid.spacing_m));
    try {
      const peak = await raster.peak(at, Math.min(reach, 64));
      if (!peak) {
        output.textContent = 'outside the image, or no power there';
        return;
      }
      const [east, north] = peak.place.map((value, axis) => value - at[axis]);
      const [right, up] = this.places.toGeographic ? ['east', 'north'] : ['along x', 'along y'];
      const off = `${number(100 * east, 1)} cm ${right}, ${number(100 * north, 1)} cm ${up} of it`;
      output.textContent = `peak ${number(peak.value, 2)} dB at ${this.places.words(peak.place)}: ${off}`;
      output.dataset.east = peak.place[0].toFixed(6);
      output.dataset.north = peak.place[1].toFixed(6);
    } catch (error) {
      output.textContent = error.message;
    }
  }
}

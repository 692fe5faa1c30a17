// Target list: known positions of points, and positions of the image peaks near these points.
import { byId, element, number } from './dom.js';

const SOURCES = { truth: 'true position', stated: 'from the config', found: 'detected in the image' };
const REACH_M = 0.3; // search radius around a target; the minimum radius is `REACH_PX` pixels
const REACH_PX = 4;

export class Targets {
  /** `raster` is a function that returns the image in dB in which to search for peaks, or null. */
  constructor(all, chart, places, raster) {
    Object.assign(this, { all, chart, places, raster });
  }

  /** List the targets for an image: targets of the campaign, and targets detected in the image. */
  list(image) {
    const shown = this.all.filter((target) => target.image === null || target.image === image);
    this.chart.mark(shown);
    byId('targets-note').textContent = shown.length
      ? 'Select a target to zoom to the target and to measure the image peak nearby.'
      : 'No targets: the campaign has neither truth.json nor reference points.';
    byId('targets').replaceChildren(...shown.map((target) => this.row(target)));
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
      output.textContent = 'select a layer in dB to measure the peak';
      return;
    }
    const reach = Math.max(REACH_PX, Math.round(REACH_M / this.places.grid.spacing_m));
    try {
      const peak = await raster.peak(at, Math.min(reach, 64));
      if (!peak) {
        output.textContent = 'the target is outside the image, or the image has no value there';
        return;
      }
      const [east, north] = peak.place.map((value, axis) => value - at[axis]);
      const [right, up] = this.places.toGeographic ? ['east', 'north'] : ['along x', 'along y'];
      const offset = `offset ${number(100 * east, 1)} cm ${right}, ${number(100 * north, 1)} cm ${up}`;
      output.textContent = `peak ${number(peak.value, 2)} dB at ${this.places.words(peak.place)}; ${offset}`;
      output.dataset.east = peak.place[0].toFixed(6);
      output.dataset.north = peak.place[1].toFixed(6);
    } catch (error) {
      output.textContent = error.message;
    }
  }
}

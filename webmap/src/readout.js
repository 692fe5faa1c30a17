// Where the pointer is, in both systems of coordinates, and what the pixel there holds.
import { byId, number } from './dom.js';

const PAUSE_MS = 40;

export class Readout {
  /** `raster` and `mask` give what is read, or null. */
  constructor(chart, places, raster, mask, classes) {
    Object.assign(this, { chart, places, raster, mask, classes, asked: 0 });
    const { map } = chart;
    map.on('pointermove', (event) => {
      if (!event.dragging) this.at(event.coordinate);
    });
    map.on('singleclick', (event) => this.at(event.coordinate));
    map.getTargetElement().addEventListener('keydown', () => {
      this.keyed = true;
    });
    map.getTargetElement().addEventListener('pointermove', () => {
      this.keyed = false;
      byId('cross').hidden = true;
    });
    map.on('moveend', () => {
      byId('cross').hidden = !this.keyed;
      if (this.keyed) this.at(chart.view.getCenter());
    });
    map.getViewport().addEventListener('pointerleave', () => this.place && this.at(this.place));
  }

  /** Tell of a place, soon. */
  at(place) {
    this.place = place;
    byId('place').textContent = this.places.words(place);
    byId('geographic').textContent = this.places.geographicWords(place);
    const asked = ++this.asked;
    setTimeout(() => asked === this.asked && this.tell(place, asked), PAUSE_MS);
  }

  refresh() {
    if (this.place) this.at(this.place);
  }

  async tell(place, asked) {
    const words = await Promise.all([this.value(place), this.masked(place)]).catch((error) => [error.message]);
    if (asked === this.asked) byId('value').textContent = words.filter(Boolean).join(' · ');
  }

  async value(place) {
    const raster = this.raster();
    if (!raster) return '';
    const value = await raster.value(place);
    return Number.isFinite(value) ? `${number(value, 2)} ${raster.layer.unit}` : 'no value';
  }

  async masked(place) {
    const mask = this.mask();
    if (!mask) return '';
    return this.classes[await mask.value(place)] ?? 'outside';
  }
}

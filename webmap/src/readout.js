// Position of the pointer in map and geographic coordinates, and value of the pixel at that position.
import { byId, number } from './dom.js';

const PAUSE_MS = 40;

export class Readout {
  /** `sides` is a function that returns label, raster and mask (or null) of each displayed image. */
  constructor(chart, places, sides, classes) {
    Object.assign(this, { chart, places, sides, classes, request: 0 });
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

  /** Show the coordinates of a point immediately, and the value of the pixel after a pause. */
  at(place) {
    this.place = place;
    byId('place').textContent = this.places.words(place);
    byId('geographic').textContent = this.places.geographicWords(place);
    const request = ++this.request;
    setTimeout(() => request === this.request && this.showValue(place, request), PAUSE_MS);
  }

  refresh() {
    if (this.place) this.at(this.place);
  }

  async showValue(place, request) {
    const words = this.sides().map(async ({ label, raster, mask }) => {
      const texts = await Promise.all([this.value(raster, place), this.masked(mask, place)]).catch((error) => [error.message]);
      return [label, ...texts].filter(Boolean).join(' · ');
    });
    const text = (await Promise.all(words)).join('   ');
    if (request === this.request) byId('value').textContent = text;
  }

  async value(raster, place) {
    if (!raster) return '';
    const value = await raster.value(place);
    return Number.isFinite(value) ? `${number(value, 2)} ${raster.layer.unit}` : 'no value';
  }

  async masked(mask, place) {
    if (!mask) return '';
    return this.classes[await mask.value(place)] ?? 'outside';
  }
}

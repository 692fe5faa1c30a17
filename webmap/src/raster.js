// Values of a GeoTIFF at full resolution, read by byte ranges, for the readout, peaks and cross-sections.
import { fromUrl } from 'geotiff';
import { top } from './peak.js';

const SAMPLES_AT_ONCE = 256;
const MOST_SAMPLES = 4000;

export class Raster {
  constructor(layer, places) {
    this.layer = layer;
    this.places = places;
    this.opened = this.open();
    this.opened.catch(() => {}); // the functions that await the promise report its error
  }

  async open() {
    const image = await (await fromUrl(this.layer.url)).getImage();
    const { bounds_m: bounds, spacing_m: spacing, shape } = this.places.grid;
    const offsets = image.getBoundingBox().map((edge, side) => Math.abs(edge - bounds[side]));
    if (image.getHeight() !== shape[0] || image.getWidth() !== shape[1] || Math.max(...offsets) > spacing / 1000)
      throw new Error(`${this.layer.file} is not on the grid of the campaign`);
    this.nodata = image.getGDALNoData();
    return image;
  }

  /** Read a window, excluding `bottom` and `right`; NaN for pixels without a value; null if outside the grid. */
  async window(top, left, bottom, right) {
    const [rows, columns] = this.places.grid.shape;
    const [row, column] = [Math.max(0, top), Math.max(0, left)];
    const [end, last] = [Math.min(rows, bottom), Math.min(columns, right)];
    if (end <= row || last <= column) return null;
    const image = await this.opened;
    const [data] = await image.readRasters({ window: [column, row, last, end] });
    const width = last - column;
    const at = (y, x) => {
      if (y < row || y >= end || x < column || x >= last) return NaN;
      const value = data[(y - row) * width + x - column];
      return value === this.nodata ? NaN : value;
    };
    return { row, column, end, last, at };
  }

  /** Return the value of the pixel at a point; NaN if the pixel has no value. */
  async value(place) {
    const [row, column] = this.places.pixelOf(place).map(Math.round);
    const window = await this.window(row, column, row + 1, column + 1);
    return window ? window.at(row, column) : NaN;
  }

  /** Return value and subpixel position of the highest peak around a point. */
  async peak(place, reach) {
    const [row, column] = this.places.pixelOf(place).map(Math.round);
    const wide = reach + 3; // `top` also uses pixels around the highest pixel
    const window = await this.window(row - wide, column - wide, row + wide + 1, column + wide + 1);
    if (!window) return null;
    let best = null;
    for (let y = row - reach; y <= row + reach; y++)
      for (let x = column - reach; x <= column + reach; x++) {
        const value = window.at(y, x);
        if (value > (best?.value ?? -Infinity)) best = { y, x, value };
      }
    if (!best) return null;
    const { y, x, value } = best;
    const [down, right] = top((dy, dx) => window.at(y + dy, x + dx));
    return { place: this.places.placeOf([y + down, x + right]), value };
  }

  /** Return distance (m), point and value of samples along a line, spaced by half a pixel; at most `MOST_SAMPLES`. */
  async along(from, to) {
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
    const count = Math.min(MOST_SAMPLES, Math.max(2, Math.ceil((2 * length) / this.places.grid.spacing_m) + 1));
    const samples = Array.from({ length: count }, (_, index) => {
      const share = index / (count - 1);
      return { distance: share * length, place: from.map((start, axis) => start + share * (to[axis] - start)) };
    });
    for (let first = 0; first < count; first += SAMPLES_AT_ONCE)
      await this.fill(samples.slice(first, first + SAMPLES_AT_ONCE));
    return samples;
  }

  async fill(samples) {
    const pixels = samples.map(({ place }) => this.places.pixelOf(place));
    const [rows, columns] = [0, 1].map((axis) => pixels.map((pixel) => pixel[axis]));
    const [top, left] = [rows, columns].map((all) => Math.floor(Math.min(...all)));
    const [bottom, right] = [rows, columns].map((all) => Math.floor(Math.max(...all)) + 2);
    const window = await this.window(top, left, bottom, right);
    const between = this.layer.unit === 'dB' ? bilinearPower : nearest;
    samples.forEach((sample, index) => {
      sample.value = window ? between(window.at, pixels[index]) : NaN;
    });
  }
}

const nearest = (at, [row, column]) => at(Math.round(row), Math.round(column));

/** Interpolate linear power bilinearly between four pixels, and return dB. */
function bilinearPower(at, [row, column]) {
  const [y, x] = [Math.floor(row), Math.floor(column)];
  const [down, right] = [row - y, column - x];
  let power = 0;
  for (const [dy, weightY] of [[0, 1 - down], [1, down]])
    for (const [dx, weightX] of [[0, 1 - right], [1, right]])
      if (weightY * weightX > 0) power += weightY * weightX * 10 ** (at(y + dy, x + dx) / 10);
  return power > 0 ? 10 * Math.log10(power) : NaN;
}

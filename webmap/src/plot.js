// Plot of values along a line, as SVG with axes.
import { drawn, number } from './dom.js';

const EDGE = { left: 52, right: 14, top: 10, bottom: 34 };

/** Plot samples (distance, value) in a box of the given size in pixels. */
export function plot(samples, unit, width, height) {
  const svg = drawn('svg', { width, height, viewBox: `0 0 ${width} ${height}`, role: 'img' });
  svg.append(drawn('title', {}, `values along the line, ${unit}`));
  const values = samples.map((sample) => sample.value).filter(Number.isFinite);
  const far = samples.at(-1).distance;
  const [low, high] = span(values);
  const x = (distance) => EDGE.left + (distance / far) * (width - EDGE.left - EDGE.right);
  const y = (value) => EDGE.top + ((high - value) / (high - low)) * (height - EDGE.top - EDGE.bottom);
  for (const [value, decimals] of ticks(low, high, Math.max(2, height / 40))) {
    svg.append(drawn('line', { x1: EDGE.left, x2: width - EDGE.right, y1: y(value), y2: y(value), class: 'rule' }));
    svg.append(drawn('text', { x: EDGE.left - 6, y: y(value) + 4, 'text-anchor': 'end' }, number(value, decimals)));
  }
  for (const [value, decimals] of ticks(0, far, Math.max(2, width / 90))) {
    svg.append(drawn('line', { x1: x(value), x2: x(value), y1: EDGE.top, y2: height - EDGE.bottom, class: 'rule' }));
    const middle = { x: x(value), y: height - EDGE.bottom + 15, 'text-anchor': 'middle' };
    svg.append(drawn('text', middle, number(value, decimals)));
  }
  svg.append(drawn('text', { x: width - EDGE.right, y: height - 4, 'text-anchor': 'end' }, 'distance along the line, m'));
  const rotated = { x: 12, y: EDGE.top + 4, transform: `rotate(-90 12 ${EDGE.top + 4})`, 'text-anchor': 'end' };
  svg.append(drawn('text', rotated, unit));
  svg.append(drawn('path', { d: path(samples, x, y), class: 'cut' }));
  return svg;
}

/** Return path data of a line that is interrupted at samples without a value. */
function path(samples, x, y) {
  let pen = 'M';
  return samples
    .map(({ distance, value }) => {
      if (!Number.isFinite(value)) {
        pen = 'M';
        return '';
      }
      const step = `${pen}${x(distance).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = 'L';
      return step;
    })
    .join('');
}

function span(values) {
  if (!values.length) return [0, 1];
  const [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [Infinity, -Infinity]);
  const margin = 0.05 * (high - low) || 1;
  return [low - margin, high + margin];
}

/** Return approximately `about` round tick values between two limits, each with its number of decimals. */
export function ticks(low, high, about) {
  const raw = (high - low) / about;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 5, 10].find((each) => each * power >= raw);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, index) => [(first + index) * step, decimals]);
}

/** Return the −3 dB width of the highest peak, metres; null if the line does not contain both edges. */
export function width3dB(samples) {
  const best = samples.reduce((highest, sample, index) => (sample.value > (samples[highest]?.value ?? -Infinity) ? index : highest), -1);
  if (best < 0) return null;
  const level = samples[best].value - 10 * Math.log10(2);
  const side = (step) => {
    for (let index = best; samples[index + step]; index += step) {
      const [inner, outer] = [samples[index], samples[index + step]];
      if (!Number.isFinite(outer.value)) return null;
      if (outer.value <= level)
        return inner.distance + ((inner.value - level) / (inner.value - outer.value)) * (outer.distance - inner.distance);
    }
    return null;
  };
  const [left, right] = [side(-1), side(1)];
  return left === null || right === null ? null : right - left;
}

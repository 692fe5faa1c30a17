// Colour ramps for values between two limits, and colours of the mask classes.
export const RAMPS = {
  grey: ['#000000', '#ffffff'],
  inferno: ['#000004', '#1b0c41', '#4a0c6b', '#781c6d', '#a52c60', '#cf4446', '#ed6925', '#fb9b06', '#f7d13d', '#fcffa4'],
  viridis: ['#440154', '#482878', '#3e4989', '#31688e', '#26828e', '#1f9e89', '#35b779', '#6ece58', '#b5de2b', '#fde725'],
  cyclic: ['#301437', '#4e186f', '#5e45a6', '#6276ba', '#7ca2c2', '#b3c6ce', '#e2d9e2', '#d4bcac', '#c6896c', '#b25652', '#8e2c50', '#581647', '#2f1436'],
};
const OF_KIND = { image: 'grey', phase: 'cyclic' };

/** Name of the colour ramp in which a layer is displayed first. */
export const rampOf = ({ kind }) => OF_KIND[kind] ?? 'viridis';
export const MASK = { 1: '#3b82f6', 2: '#f59e0b', 3: '#d946ef' };
export const MASK_NAMES = { 1: 'blue', 2: 'orange', 3: 'magenta' };

const CLEAR = ['color', 0, 0, 0, 0];

/** Style of a layer: colour ramp between the variables `low` and `high`; pixels without a value are transparent. */
export function rampStyle(name, low, high) {
  const share = ['clamp', ['/', ['-', ['band', 1], ['var', 'low']], ['-', ['var', 'high'], ['var', 'low']]], 0, 1];
  const ramp = RAMPS[name];
  const stops = ramp.flatMap((colour, index) => [index / (ramp.length - 1), colour]);
  const colour = ['interpolate', ['linear'], share, ...stops];
  return { variables: { low, high }, color: ['case', ['==', ['band', 2], 0], CLEAR, colour] };
}

/** Style of the mask; pixels of class 'visible' are transparent. */
export function maskStyle() {
  const cases = Object.entries(MASK).flatMap(([value, colour]) => [['==', ['band', 1], Number(value)], colour]);
  return { color: ['case', ['==', ['band', 2], 0], CLEAR, ...cases, CLEAR] };
}

/** Draw a colour ramp from left to right. */
export function drawRamp(canvas, name) {
  const pen = canvas.getContext('2d');
  const fill = pen.createLinearGradient(0, 0, canvas.width, 0);
  RAMPS[name].forEach((colour, index, all) => fill.addColorStop(index / (all.length - 1), colour));
  pen.fillStyle = fill;
  pen.fillRect(0, 0, canvas.width, canvas.height);
}

// PNG of the view for a report: the map with scale bar and north arrow, and below it the colour bar, verdict and flags of
// each displayed image, CRS and sources. The height grows with the text, so that no flag is omitted.
import { drawRamp } from './colours.js';

const MARGIN = 16;
const FONT = 'system-ui, "DejaVu Sans", sans-serif';
const STYLES = {
  title: { size: 18, weight: 'bold', colour: '#000000' },
  text: { size: 12, weight: 'normal', colour: '#000000' },
  flag: { size: 12, weight: 'bold', colour: '#b91c1c' },
  note: { size: 11, weight: 'normal', colour: '#475569' },
};

/**
 * Draw the picture; return its canvas.
 * `columns` holds for each displayed image { colours, low, high, quantity, lines }; lines are [style, text]; `notes` are
 * the lines at the bottom, and `divider` is the position of the divider as a fraction of the width, or null.
 */
export function picture(chart, { title, columns, north, notes, divider }) {
  const [width, height] = chart.map.getSize();
  const ratio = devicePixelRatio || 1;
  const wide = (width - MARGIN * (columns.length - 1)) / columns.length;
  const pen = document.createElement('canvas').getContext('2d');
  const [head, foot] = [wrapped(pen, [['title', title]], width), wrapped(pen, notes, width)];
  const bodies = columns.map(({ quantity, lines }) => wrapped(pen, [['text', quantity], ...lines], wide));
  const [top, below] = [MARGIN + tall(head) + 8, Math.max(...bodies.map(tall)) + 44];
  Object.assign(pen.canvas, { width: ratio * (width + 2 * MARGIN), height: ratio * (top + height + below + tall(foot) + 2 * MARGIN) });
  pen.scale(ratio, ratio);
  pen.fillStyle = '#ffffff';
  pen.fillRect(0, 0, pen.canvas.width, pen.canvas.height);
  write(pen, head, MARGIN, MARGIN);
  write(pen, foot, MARGIN, top + height + below + MARGIN / 2);
  columns.forEach((column, index) => {
    const [left, y] = [MARGIN + index * (wide + MARGIN), top + height + 10];
    bar(pen, column, left, y, Math.min(wide, 320));
    write(pen, bodies[index], left, y + 32);
  });

  pen.save();
  pen.translate(MARGIN, top);
  pen.beginPath();
  pen.rect(0, 0, width, height);
  pen.clip();
  pen.fillStyle = '#060a13';
  pen.fillRect(0, 0, width, height);
  chart.draw(pen);
  pen.fillStyle = '#ffffff';
  if (divider !== null) pen.fillRect(divider * width - 1, 0, 2, height);
  furniture(pen, chart.bar, north, width, height);
  pen.restore();
  return pen.canvas;
}

/** Draw scale bar and north arrow over the map. */
function furniture(pen, { length, text }, north, width, height) {
  pen.fillStyle = '#0b1220cc';
  pen.fillRect(10, height - 36, length + 20, 28);
  pen.fillRect(width - 56, 8, 48, 56);
  pen.fillStyle = '#ffffff';
  for (const [x, y, w, h] of [[20, height - 14, length, 2], [20, height - 20, 2, 8], [18 + length, height - 20, 2, 8]]) pen.fillRect(x, y, w, h);
  pen.textAlign = 'center';
  pen.font = `12px ${FONT}`;
  pen.fillText(text, 20 + length / 2, height - 22);
  pen.fillText(north, width - 32, 58);
  pen.beginPath();
  for (const [x, y] of [[0, 14], [9, 42], [0, 36], [-9, 42]]) pen.lineTo(width - 32 + x, y);
  pen.fill();
}

function bar(pen, { colours, low, high }, left, top, width) {
  const ramp = Object.assign(document.createElement('canvas'), { width: 256, height: 1 });
  drawRamp(ramp, colours);
  pen.drawImage(ramp, left, top, width, 12);
  pen.strokeStyle = '#000000';
  pen.lineWidth = 0.5;
  pen.strokeRect(left, top, width, 12);
  style(pen, 'text');
  pen.fillText(low, left, top + 26);
  pen.textAlign = 'right';
  pen.fillText(high, left + width, top + 26);
  pen.textAlign = 'left';
}

function style(pen, name) {
  const { size, weight, colour } = STYLES[name];
  pen.font = `${weight} ${size}px ${FONT}`;
  pen.fillStyle = colour;
  pen.textAlign = 'left';
  return 1.35 * size;
}

/** Break lines [style, text] at spaces, or inside a word that is longer than the width. */
function wrapped(pen, lines, width) {
  return lines.flatMap(([name, text]) => {
    style(pen, name);
    const broken = [''];
    for (const part of text.split(/(?<= )/)) {
      if (broken.at(-1) && pen.measureText(broken.at(-1) + part.trimEnd()).width > width) broken.push('');
      for (const letter of part) {
        if (broken.at(-1) && letter !== ' ' && pen.measureText(broken.at(-1) + letter).width > width) broken.push('');
        broken[broken.length - 1] += letter;
      }
    }
    return broken.map((line) => [name, line]);
  });
}

/** Height of lines in whole pixels, so that the map is drawn without interpolation. */
const tall = (lines) => Math.ceil(lines.reduce((height, [name]) => height + 1.35 * STYLES[name].size, 0));

function write(pen, lines, left, top) {
  let y = top;
  for (const [name, text] of lines) {
    y += style(pen, name);
    pen.fillText(text, left, y - 0.3 * STYLES[name].size);
  }
}

// Subpixel position of a peak in dB: least-squares fit of a paraboloid to the pixels within 3 dB of the peak.
const REACH = 3; // pixels; a resolution cell is about three pixels wide
const WITHIN_DB = 3;
const TERMS = (y, x) => [1, y, x, y * y, x * x, x * y];

/** Return the offset [down, right] of the peak from the highest pixel; `at(down, right)` returns the value in dB at an offset. */
export function top(at) {
  const around = [];
  for (let y = -REACH; y <= REACH; y++) for (let x = -REACH; x <= REACH; x++) around.push([y, x, at(y, x) - at(0, 0)]);
  const near = around.filter(([, , value]) => value >= -WITHIN_DB);
  const used = near.length > TERMS(0, 0).length ? near : around.filter(([y, x]) => Math.max(Math.abs(y), Math.abs(x)) <= 1);
  const [, down, right, bendY, bendX, twist] = leastSquares(used);
  const determinant = 4 * bendY * bendX - twist * twist;
  if (!(bendY < 0 && determinant > 0)) return [0, 0]; // the paraboloid has no maximum
  const offset = [(twist * right - 2 * bendX * down) / determinant, (twist * down - 2 * bendY * right) / determinant];
  return Math.max(...offset.map(Math.abs)) <= 2 ? offset : [0, 0];
}

/** Return the least-squares coefficients of `TERMS` from the normal equations, solved by elimination with pivoting. */
function leastSquares(samples) {
  const count = TERMS(0, 0).length;
  const rows = Array.from({ length: count }, () => new Array(count + 1).fill(0));
  for (const [y, x, value] of samples) {
    const terms = [...TERMS(y, x), value];
    for (let i = 0; i < count; i++) for (let j = 0; j <= count; j++) rows[i][j] += terms[i] * terms[j];
  }
  for (let i = 0; i < count; i++) {
    const pivot = rows.reduce((best, row, at) => (at >= i && Math.abs(row[i]) > Math.abs(rows[best][i]) ? at : best), i);
    [rows[i], rows[pivot]] = [rows[pivot], rows[i]];
    for (let k = 0; k < count; k++) {
      if (k === i) continue;
      const share = rows[k][i] / rows[i][i];
      for (let j = i; j <= count; j++) rows[k][j] -= share * rows[i][j];
    }
  }
  return rows.map((row, i) => row[count] / row[i]);
}

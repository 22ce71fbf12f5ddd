/** QR codes of short texts: bytes, correction level M, versions 1 to 6. Pure. After ISO/IEC 18004, whose names it uses. */

export const MOST_BYTES = 106;

/** @type {[number, number, number][]} of each version: blocks, and the data and correction codewords of a block */
const VERSIONS = [
  [1, 16, 10],
  [1, 28, 16],
  [1, 44, 26],
  [2, 32, 18],
  [2, 43, 24],
  [4, 27, 16],
];
const LEVEL_M = 0;

/** @typedef {number[][]} Grid rows of modules; 1 is dark */

/** @param {string} text @returns {Grid | null} without the quiet zone; null: the text is too long */
export function qrCode(text) {
  const bytes = new TextEncoder().encode(text);
  const number = VERSIONS.findIndex(([blocks, data]) => bytes.length <= blocks * data - 2) + 1;
  if (!number) return null;
  const bits = codewords(bytes, VERSIONS[number - 1]).flatMap((byte) => bitsOf(byte, 8));
  const patterns = functionPatterns(number);
  const drawn = MASKS.map((mask, index) => masked(patterns, bits, mask, index));
  const penalties = drawn.map(penalty);
  return drawn[penalties.indexOf(Math.min(...penalties))];
}

const bitsOf = (value, count) => Array.from({ length: count }, (_, i) => (value >> (count - 1 - i)) & 1);

// -- codewords

const EXP = [1];
for (let i = 1; i < 255; i++) EXP[i] = (EXP[i - 1] << 1) ^ (EXP[i - 1] & 128 ? 0x11d : 0);
const LOG = Object.fromEntries(EXP.map((value, i) => [value, i]));
const times = (a, b) => (a && b ? EXP[(LOG[a] + LOG[b]) % 255] : 0);

/** The text's codewords and their corrections, blocks interleaved. */
function codewords(bytes, [blocks, size, correctionSize]) {
  const total = blocks * size;
  const bits = [...bitsOf(0b0100, 4), ...bitsOf(bytes.length, 8), ...[...bytes].flatMap((byte) => bitsOf(byte, 8))];
  const data = [];
  for (let i = 0; i < bits.length; i += 8) data.push(parseInt(bits.slice(i, i + 8).join("").padEnd(8, "0"), 2));
  for (let i = 0; data.length < total; i++) data.push(i % 2 ? 0x11 : 0xec);
  const parts = Array.from({ length: blocks }, (_, i) => data.slice(i * size, (i + 1) * size));
  return [...interleaved(parts), ...interleaved(parts.map((part) => correction(part, correctionSize)))];
}

const interleaved = (parts) => parts[0].flatMap((_, i) => parts.map((part) => part[i]));

/** Reed-Solomon: the remainder of the data, divided by the product of (x - 2^i). */
function correction(data, count) {
  let divisor = [1];
  for (let i = 0; i < count; i++) {
    const shifted = [...divisor, 0];
    divisor = shifted.map((value, at) => value ^ (at ? times(divisor[at - 1], EXP[i]) : 0));
  }
  const rest = [...data, ...Array(count).fill(0)];
  for (let i = 0; i < data.length; i++) {
    const factor = rest[i];
    divisor.forEach((value, at) => (rest[i + at] ^= times(value, factor)));
  }
  return rest.slice(data.length);
}

// -- modules

/** Finders, timing, alignment and the place of the format; -1 is free for data. @returns {Grid} */
function functionPatterns(version) {
  const size = 17 + 4 * version;
  const grid = Array.from({ length: size }, () => Array(size).fill(-1));
  for (let i = 0; i < size; i++) grid[6][i] = grid[i][6] = (i + 1) % 2;
  for (const [x, y] of [[3, 3], [size - 4, 3], [3, size - 4]]) square(grid, x, y, 4, (ring) => ring !== 2 && ring !== 4);
  if (version > 1) square(grid, size - 7, size - 7, 2, (ring) => ring !== 1);
  for (let i = 0; i < 9; i++) grid[8][i] = grid[i][8] = Number(i === 6);
  for (let i = 1; i <= 8; i++) grid[8][size - i] = grid[size - i][8] = 0;
  return grid;
}

function square(grid, x, y, reach, isDark) {
  for (let dx = -reach; dx <= reach; dx++) {
    for (let dy = -reach; dy <= reach; dy++) {
      const row = grid[y + dy];
      if (row?.[x + dx] !== undefined) row[x + dx] = Number(isDark(Math.max(Math.abs(dx), Math.abs(dy))));
    }
  }
}

const MASKS = [
  (x, y) => (x + y) % 2,
  (x, y) => y % 2,
  (x) => x % 3,
  (x, y) => (x + y) % 3,
  (x, y) => (Math.floor(x / 3) + Math.floor(y / 2)) % 2,
  (x, y) => ((x * y) % 2) + ((x * y) % 3),
  (x, y) => (((x * y) % 2) + ((x * y) % 3)) % 2,
  (x, y) => (((x + y) % 2) + ((x * y) % 3)) % 2,
];

/** With the data, where the mask inverts, and the format, which names the mask. */
function masked(patterns, bits, mask, index) {
  const size = patterns.length;
  const grid = patterns.map((row) => [...row]);
  let next = 0;
  for (const [x, y] of zigzag(size)) {
    if (patterns[y][x] === -1) grid[y][x] = (bits[next++] ?? 0) ^ Number(mask(x, y) === 0);
  }
  drawFormat(grid, index);
  return grid;
}

/** Pairs of columns from the right, up and down in turns; the column of the timing pattern is left out. */
function* zigzag(size) {
  let up = true;
  for (let right = size - 1; right > 0; right -= 2, up = !up) {
    if (right === 6) right = 5;
    for (let i = 0; i < size; i++) {
      const y = up ? size - 1 - i : i;
      yield [right, y];
      yield [right - 1, y];
    }
  }
}

function drawFormat(grid, mask) {
  const size = grid.length;
  const data = (LEVEL_M << 3) | mask;
  let rest = data;
  for (let i = 0; i < 10; i++) rest = (rest << 1) ^ ((rest >> 9) * 0x537);
  const bits = bitsOf(((data << 10) | rest) ^ 0x5412, 15).reverse();
  const line = [0, 1, 2, 3, 4, 5, 7, 8]; // without the timing pattern
  line.forEach((at, i) => {
    grid[at][8] = bits[i];
    grid[8][at] = bits[14 - i];
    grid[8][size - 1 - i] = bits[i];
    if (i < 7) grid[size - 1 - i][8] = bits[14 - i];
  });
  grid[8][8] = bits[7];
  grid[size - 8][8] = 1;
}

/** How hard it is to read: of all masks the one with the least is taken. @param {Grid} grid @returns {number} */
function penalty(grid) {
  const size = grid.length;
  const lines = [...grid, ...grid.map((_, x) => grid.map((row) => row[x]))].map((line) => line.join(""));
  let sum = 0;
  for (const line of lines) {
    for (const [run] of line.matchAll(/0{5,}|1{5,}/g)) sum += run.length - 2;
    sum += 40 * [...line.matchAll(/(?=00001011101|10111010000)/g)].length;
  }
  for (let y = 1; y < size; y++) {
    for (let x = 1; x < size; x++) {
      const four = grid[y][x] + grid[y - 1][x] + grid[y][x - 1] + grid[y - 1][x - 1];
      if (four % 4 === 0) sum += 3;
    }
  }
  const dark = grid.flat().filter(Boolean).length / size ** 2;
  return sum + 10 * Math.floor(Math.abs(dark - 0.5) / 0.05);
}

/** @param {Grid} grid @returns {string} the dark modules as the path of an SVG, one unit each */
export const pathOf = (grid) =>
  grid.flatMap((row, y) => row.flatMap((dark, x) => (dark ? `M${x} ${y}h1v1h-1z` : []))).join("");

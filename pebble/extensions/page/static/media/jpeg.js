// The size of a JPEG before it is decoded: a few bytes may claim a picture of gigabytes. Browsers refuse what is damaged. Pure.

export const MAX_BYTES = 8 << 20;
const MAX_EDGE = 4096;
const NO_FRAMES = [0xc4, 0xc8, 0xcc]; // of the markers C0 to CF, all others begin a picture
const [EXIF, COMMENT] = [0xe1, 0xfe];

/**
 * The size, and the JPEG without what would make a browser turn it. Throws an Error unless it may be shown.
 * @param {Uint8Array} jpeg
 * @returns {{width: number, height: number, plain: Uint8Array}}
 */
export function checked(jpeg) {
  let plain = jpeg;
  if (jpeg.length > MAX_BYTES) throw new Error(`JPEG: ${jpeg.length} bytes, more than ${MAX_BYTES}`);
  for (let at = 2; jpeg[at] === 0xff && at + 8 < jpeg.length; at += 2 + ((jpeg[at + 2] << 8) | jpeg[at + 3])) {
    const marker = jpeg[at + 1];
    if (marker === EXIF) {
      if (plain === jpeg) plain = jpeg.slice();
      plain[at + 1] = COMMENT;
    }
    if (marker < 0xc0 || marker > 0xcf || NO_FRAMES.includes(marker)) continue;
    const [height, width] = [(jpeg[at + 5] << 8) | jpeg[at + 6], (jpeg[at + 7] << 8) | jpeg[at + 8]];
    if (width >= 1 && width <= MAX_EDGE && height >= 1 && height <= MAX_EDGE) return { width, height, plain };
    throw new Error(`JPEG: ${width}x${height}, larger than ${MAX_EDGE}x${MAX_EDGE} or nothing`);
  }
  throw new Error("JPEG: without a size");
}

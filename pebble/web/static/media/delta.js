// Adds a difference to the picture that it builds on.

const UNCHANGED = new Uint32Array(new Uint8Array([128, 128, 128, 255]).buffer)[0]; // most pixels of most differences

/**
 * reference = clip(reference + difference - 128). The array clips by itself; alpha stays 255.
 * @param {Uint8ClampedArray} reference RGBA, changed in place
 * @param {Uint8ClampedArray} difference RGBA, of the same size
 */
export function addDifference(reference, difference) {
  const pixels = new Uint32Array(difference.buffer, difference.byteOffset, difference.length >> 2);
  for (let pixel = 0; pixel < pixels.length; pixel++) {
    if (pixels[pixel] === UNCHANGED) continue;
    const i = 4 * pixel;
    reference[i] = reference[i] + difference[i] - 128;
    reference[i + 1] = reference[i + 1] + difference[i + 1] - 128;
    reference[i + 2] = reference[i + 2] + difference[i + 2] - 128;
  }
}

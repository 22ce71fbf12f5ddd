// Adds a difference to the picture that it builds on.

/**
 * reference = clip(reference + difference - 128). The array clips by itself; alpha stays 255.
 * @param {Uint8ClampedArray} reference RGBA, changed in place
 * @param {Uint8ClampedArray} difference RGBA, of the same size
 */
export function addDifference(reference, difference) {
  const length = reference.length;
  for (let i = 0; i < length; i++) reference[i] = reference[i] + difference[i] - 128;
}

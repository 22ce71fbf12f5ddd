// The worker of pictures.js: ../video-worker.js, but a bitmap of a frame of H.264 is made of its copied pixels.
// Else it is the graphics processor's, and of pictures that come one at a time Chromium 150 takes 4 MB for every three,
// up to half a gigabyte. Where pictures follow one another that memory is used again.

import * as browser from "../../core/browser.js";
import "../video-worker.js";

const OPTIONS = /** @type {any} */ ({ format: "RGBA" });
const bitmapOf = browser.find("createImageBitmap").bind(self);

self.createImageBitmap = /** @type {any} */ (
  (/** @type {any} */ source, /** @type {any[]} */ ...rest) =>
    self.VideoFrame && source instanceof VideoFrame ? copied(source) : bitmapOf(source, ...rest)
);

/** @param {VideoFrame} frame @returns {Promise<ImageBitmap>} */
async function copied(frame) {
  const { width, height } = frame.visibleRect ?? { width: 0, height: 0 };
  const pixels = new Uint8ClampedArray(4 * width * height);
  try {
    if (frame.allocationSize(OPTIONS) !== pixels.length) return await bitmapOf(frame);
    await frame.copyTo(pixels, OPTIONS);
  } catch {
    return bitmapOf(frame); // this browser converts no formats
  }
  return bitmapOf(new ImageData(pixels, width, height));
}

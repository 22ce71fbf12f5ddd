// Feeds payloads to the page's decoder, and compares its pictures with those of pebble.extensions.media.decode.

import { H264Decoder } from "/media/h264.js";
import { PictureDecoder } from "/media/picture-decoder.js";

// A busy machine may need longer for a picture than a page waits before it shows the one before.
const { ready } = H264Decoder.prototype;
H264Decoder.prototype.ready = function () {
  return ready.call(this, 10_000);
};

function pixelsOf(bitmap) {
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
}

/** -1: another size. */
function largestDifference(pixels, expected) {
  if (pixels.length !== expected.length) return -1;
  return pixels.reduce((most, value, at) => Math.max(most, Math.abs(value - expected[at])), 0);
}

/** For each payload null, or what was shown: number, time, size and the largest difference from what is expected. */
window.compare = async (payloads, expected) => {
  const decoder = new PictureDecoder();
  const shown = [];
  const wants = [];
  for (const [index, payload] of payloads.entries()) {
    const made = await decoder.feed(Uint8Array.fromBase64(payload));
    wants.push(decoder.sequence.wantsKeyframe);
    if (made === null) {
      shown.push(null);
      continue;
    }
    const { bitmap, encoding, key, frame, capturedMs } = made;
    const difference = largestDifference(pixelsOf(bitmap), Uint8Array.fromBase64(expected[index]));
    shown.push({ encoding, key, frame, capturedMs, width: bitmap.width, height: bitmap.height, difference });
    bitmap.close();
  }
  decoder.h264.close();
  return { shown, wants };
};

window.ready = true;

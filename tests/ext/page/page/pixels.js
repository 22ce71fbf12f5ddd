// Feeds payloads to the page's decoder, and compares its pictures with those of pebble.extensions.media.decode.

import { H264Decoder } from "/media/h264.js";
import { PictureDecoder } from "/media/picture-decoder.js";

// A busy machine may need longer for a picture than a page waits before it shows the one before.
const { ready } = H264Decoder.prototype;
H264Decoder.prototype.ready = function () {
  return ready.call(this, 10_000);
};

/** The byte strings of a list, each behind its length. */
async function list(path) {
  const buffer = await (await fetch(path)).arrayBuffer();
  const view = new DataView(buffer);
  const parts = [];
  for (let at = 0; at < buffer.byteLength; at += 4 + view.getUint32(at)) {
    parts.push(new Uint8Array(buffer, at + 4, view.getUint32(at)));
  }
  return parts;
}

function pixelsOf(bitmap) {
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
}

/** Red, green and blue of each pixel; -1: another size. */
function largestDifference(rgba, rgb) {
  if ((rgba.length / 4) * 3 !== rgb.length) return -1;
  let largest = 0;
  for (let from = 0, to = 0; to < rgb.length; from += 4, to += 3) {
    for (let colour = 0; colour < 3; colour++) {
      largest = Math.max(largest, Math.abs(rgba[from + colour] - rgb[to + colour]));
    }
  }
  return largest;
}

/** For each payload null, or what was shown: number, time, size and the largest difference from what is expected. */
window.compare = async (payloadsPath, expectedPath) => {
  const [payloads, expected] = [await list(payloadsPath), await list(expectedPath)];
  const decoder = new PictureDecoder();
  const shown = [];
  const wants = [];
  for (const [index, payload] of payloads.entries()) {
    const made = await decoder.feed(payload);
    wants.push(decoder.sequence.wantsKeyframe);
    if (made === null) {
      shown.push(null);
      continue;
    }
    const { bitmap, encoding, key, frame, capturedMs } = made;
    const difference = largestDifference(pixelsOf(bitmap), expected[index]);
    shown.push({ encoding, key, frame, capturedMs, width: bitmap.width, height: bitmap.height, difference });
    bitmap.close();
  }
  decoder.h264.close();
  return { shown, wants };
};

/** Decode everything: what went wrong, and the pictures' pixels, RGBA behind width and height, as base64. */
window.pixels = async (payloadsPath) => {
  const decoder = new PictureDecoder();
  const parts = [];
  for (const payload of await list(payloadsPath)) {
    const made = await decoder.feed(payload);
    if (made === null) continue;
    parts.push(new Uint32Array([made.bitmap.width, made.bitmap.height]), pixelsOf(made.bitmap));
    made.bitmap.close();
  }
  decoder.h264.close();
  const bytes = new Uint8Array(await new Blob(parts).arrayBuffer());
  let text = "";
  for (let at = 0; at < bytes.length; at += 32_768) text += String.fromCharCode(...bytes.subarray(at, at + 32_768));
  return [decoder.sequence.problem, btoa(text)];
};

window.ready = true;

// Decodes the payloads of one robot into bitmaps: pebble/extensions/media/decode.py for browsers, pixel by pixel the same.

import * as browser from "../core/browser.js";
import { Sequence, inflate, readPayload } from "./decode.js";
import { H264Decoder, UnsupportedError } from "./h264.js";
import { checked } from "./jpeg.js";

const UNCHANGED = new Uint32Array(new Uint8Array([128, 128, 128, 255]).buffer)[0]; // most pixels of most differences
// No profile may change a pixel: a difference would not fit any more.
const AS_IT_IS = /** @type {const} */ ({ colorSpaceConversion: "none", premultiplyAlpha: "none" });

/**
 * @typedef {object} Decoded
 * @property {ImageBitmap} bitmap the caller's own
 * @property {string} encoding
 * @property {boolean} key
 * @property {number|null} frame
 * @property {number|null} capturedMs
 */

/** Decodes payloads in any order and encoding; after a lost or damaged one nothing is shown until a key frame. */
export class PictureDecoder {
  constructor() {
    this.sequence = new Sequence();
    this.unsupported = false; // whether the last payload failed for lack of a decoder
    this.h264 = new H264Decoder();
    /** @type {OffscreenCanvasRenderingContext2D|null} */
    this.context = null;
    /** @type {ImageData|null} */
    this.reference = null; // null: the canvas holds the picture that the next difference builds on
  }

  /**
   * The picture of this payload; null if it is refused, or waits for a key frame or for its decoder. Never throws for a
   * payload. One call at a time.
   * @param {Uint8Array} bytes
   * @param {boolean} [quiet] no picture is made of it: only the following ones build on it
   * @returns {Promise<Decoded|null>}
   */
  async feed(bytes, quiet = false) {
    this.unsupported = false;
    try {
      const payload = readPayload(bytes);
      if (payload.packed) payload.body = await inflate(payload.body);
      if (!this.sequence.admit(payload)) {
        this.h264.forget();
        return null;
      }
      const decoded = payload.encoding === "h264" ? await this.unit(payload, quiet) : await this.jpeg(payload, quiet);
      this.sequence.shown(payload);
      return decoded;
    } catch (error) {
      this.h264.close();
      this.sequence.refuse(error);
      this.unsupported = error instanceof UnsupportedError;
      return null;
    }
  }

  /** After a seek, or on another connection. */
  restart() {
    this.h264.forget();
    this.sequence.last = null;
  }

  /** @param {import("./decode.js").Payload} payload @param {boolean} quiet */
  async unit(payload, quiet) {
    if (this.sequence.last === null) this.h264.forget();
    const made = await this.h264.decode(payload.body, payload.keyframe, quiet ? null : labelOf(payload));
    if (made === null) return null;
    try {
      return { bitmap: await browser.find("createImageBitmap")(made.frame), ...made.label };
    } finally {
      made.frame.close();
    }
  }

  /** @param {import("./decode.js").Payload} payload @param {boolean} quiet */
  async jpeg(payload, quiet) {
    if (quiet && payload.encoding === "jpeg") return null;
    const picture = await decodeJpeg(payload.body);
    if (payload.encoding === "jpeg") return { bitmap: picture, ...labelOf(payload) };
    if (payload.keyframe) {
      this.begin(picture);
      if (!quiet) return { bitmap: picture, ...labelOf(payload) };
      picture.close();
      return null;
    }
    const whole = this.add(picture);
    return quiet ? null : { bitmap: await browser.find("createImageBitmap")(whole), ...labelOf(payload) };
  }

  /** Let differences build on this picture. */
  begin(/** @type {ImageBitmap} */ picture) {
    const { width, height } = picture;
    if (!this.context || this.context.canvas.width !== width || this.context.canvas.height !== height) {
      const context = new (browser.find("OffscreenCanvas"))(width, height).getContext("2d", { willReadFrequently: true });
      if (!context) throw new UnsupportedError("this browser has no canvas for pictures");
      this.context = context;
    }
    this.context.drawImage(picture, 0, 0);
    this.reference = null;
  }

  /** @param {ImageBitmap} difference @returns {ImageData} the picture that it makes of the last one */
  add(difference) {
    const { context } = this;
    const { width, height } = difference;
    if (!context || context.canvas.width !== width || context.canvas.height !== height) {
      throw new Error("a difference of another size than the picture it builds on");
    }
    const reference = this.reference ?? context.getImageData(0, 0, width, height);
    context.drawImage(difference, 0, 0);
    difference.close();
    addDifference(reference.data, context.getImageData(0, 0, width, height).data);
    this.reference = reference;
    return reference;
  }
}

/**
 * A bitmap of a whole JPEG; throws an Error for anything else.
 * @param {Uint8Array} bytes
 * @returns {Promise<ImageBitmap>}
 */
export async function decodeJpeg(bytes) {
  const { width, height, plain } = checked(bytes);
  let bitmap;
  try {
    bitmap = await browser.find("createImageBitmap")(new Blob([/** @type {any} */ (plain)], { type: "image/jpeg" }), AS_IT_IS);
  } catch (error) {
    throw new Error(`JPEG: ${error}`);
  }
  if (bitmap.width !== width || bitmap.height !== height) throw new Error("JPEG: decoded to another size");
  return bitmap;
}

/** @param {import("./decode.js").Payload} payload */
function labelOf({ encoding, keyframe, frame, capturedMs }) {
  return { encoding, key: keyframe, frame, capturedMs };
}

/**
 * reference = clip(reference + difference - 128). The array clips by itself; alpha stays 255.
 * @param {Uint8ClampedArray} reference RGBA, changed in place
 * @param {Uint8ClampedArray} difference RGBA, of the same size
 */
function addDifference(reference, difference) {
  const pixels = new Uint32Array(difference.buffer, difference.byteOffset, difference.length >> 2);
  for (let pixel = 0; pixel < pixels.length; pixel++) {
    if (pixels[pixel] === UNCHANGED) continue;
    const i = 4 * pixel;
    reference[i] = reference[i] + difference[i] - 128;
    reference[i + 1] = reference[i + 1] + difference[i + 1] - 128;
    reference[i + 2] = reference[i + 2] + difference[i + 2] - 128;
  }
}

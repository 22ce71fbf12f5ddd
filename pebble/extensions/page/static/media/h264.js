// Decodes access units of H.264 with WebCodecs, one picture for each.

import * as browser from "../core/browser.js";
import { checkUnit } from "./access-unit.js";

const HELD_MS = 150; // some decoders give a picture out only when the next one comes
const UNABLE = "This browser cannot play H.264 video: open the page in another browser";
const FAILURES = 2; // key frames in a row that are whole and fail: this browser cannot decode them

/** This browser lacks what it takes to decode; a key frame does not help. */
export class UnsupportedError extends Error {}

/** Like pebble.extensions.media.h264.H264Decoder; after an error the next unit has to be a key frame. */
export class H264Decoder {
  constructor() {
    /** @type {VideoDecoder|null} */
    this.decoder = null;
    this.codec = "";
    this.failures = 0;
    this.units = 0;
    /** @type {Map<number, any>} */
    this.labels = new Map(); // of units that are being decoded, by timestamp
    /** @type {Array<{frame: VideoFrame, label: any}>} */
    this.made = [];
    /** @type {Error|null} */
    this.error = null;
    this.wake = () => {};
  }

  /**
   * The newest picture that is ready, with its label; null if the decoder holds it back. Throws an Error for what
   * is damaged, UnsupportedError where this browser has no decoder.
   * @param {Uint8Array} unit with its seal, which decoders skip
   * @param {boolean} keyframe
   * @param {any} label returned with the picture of this unit; null: that one is not waited for, nor given out
   */
  async decode(unit, keyframe, label) {
    const codec = checkUnit(unit, keyframe);
    try {
      await this.submit(unit, codec, label);
      if (label === null) return null;
      const made = await this.newest();
      this.failures = 0;
      return made;
    } catch (error) {
      this.close();
      this.failures += keyframe ? 1 : 0;
      if (this.failures >= FAILURES) throw new UnsupportedError(`h264: ${error}`);
      throw error instanceof UnsupportedError ? error : new Error(`h264: ${error}`);
    }
  }

  /** The next unit builds on nothing before. The decoder stays: a new one for each seek takes time. */
  forget() {
    this.labels.clear();
    for (const { frame } of this.made.splice(0)) frame.close();
  }

  close() {
    if (this.decoder?.state === "configured") this.decoder.close();
    this.decoder = null;
    this.error = null;
    this.forget();
  }

  /** @param {Uint8Array} unit @param {string|null} codec of a key frame @param {any} label */
  async submit(unit, codec, label) {
    if (codec !== null && (this.decoder === null || codec !== this.codec)) await this.open(codec);
    if (this.decoder === null) throw new Error("no key frame yet");
    const timestamp = this.units++;
    this.labels.set(timestamp, label);
    this.decoder.decode(new (browser.find("EncodedVideoChunk"))({ type: codec === null ? "delta" : "key", timestamp, data: unit }));
  }

  /** @param {string} codec */
  async open(codec) {
    this.close();
    if (!browser.find("VideoDecoder")) throw new UnsupportedError(UNABLE);
    const config = { codec, optimizeForLatency: true }; // without a description: Annex B
    if (!(await browser.find("VideoDecoder").isConfigSupported(config)).supported) {
      throw new UnsupportedError(UNABLE);
    }
    const decoder = new (browser.find("VideoDecoder"))({
      output: (frame) => this.take(decoder, frame),
      error: (error) => {
        if (this.decoder === decoder) this.error = error;
        this.wake();
      },
    });
    decoder.configure(config);
    this.decoder = decoder;
    this.codec = codec;
  }

  /** @param {VideoDecoder} decoder @param {VideoFrame} frame */
  take(decoder, frame) {
    const label = this.decoder === decoder && this.labels.get(frame.timestamp);
    if (label) this.made.push({ frame, label });
    else frame.close(); // not shown, or forgotten
    this.labels.delete(frame.timestamp);
    this.wake();
  }

  async newest() {
    let works = true;
    while (works && !this.made.length && !this.error) works = await this.ready(HELD_MS);
    if (this.error) throw this.error;
    const newest = this.made.pop() ?? null;
    for (const { frame } of this.made.splice(0)) frame.close();
    return newest;
  }

  /**
   * Wait for a picture, an error or the timeout.
   * @param {number} timeout @returns {Promise<boolean>} false: it was the timeout
   */
  ready(timeout) {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, timeout, false);
      this.wake = () => {
        clearTimeout(timer);
        resolve(true);
      };
    });
  }
}

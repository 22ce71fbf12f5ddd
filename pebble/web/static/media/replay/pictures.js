// The pictures of a recording: recorded payloads in, bitmaps out, by the same worker as live ones.

import * as browser from "../../core/browser.js";

const HEAD_BYTES = 5; // u32 number, u8 kind: as the messages of the server
const MOST_PENDING = 24; // pictures at the worker; the replay waits for it

/** @typedef {import("../pictures.js").Info & {receivedMs: number}} RecordedInfo */

export class ReplayPictures {
  /**
   * @param {(bitmap: ImageBitmap, info: RecordedInfo) => void} draw draws at once; the bitmap is closed afterwards
   * @param {(problem: string) => void} onProblem "" there is none any more
   */
  constructor(draw, onProblem) {
    this.draw = draw;
    this.onProblem = onProblem;
    /** @type {Worker | null} */
    this.worker = null;
    this.run = 0; // what is left of an earlier one is not drawn
    this.number = 0;
    this.metric = ""; // of the camera that is shown: the first one
    this.problem = "";
    /** @type {Map<number, number>} when the pictures that are at the worker were received, by number */
    this.pending = new Map();
  }

  /** Whether the worker is behind. */
  get busy() {
    return this.pending.size >= MOST_PENDING;
  }

  /** A seek: nothing of before is drawn, or built on. */
  reset() {
    this.run++;
    this.pending.clear();
    this.metric = "";
    this.change("");
  }

  /** Pictures that are due together, in order: only the last one is shown. @param {import("../../core/replay/frames.js").Frame[]} frames */
  take(frames) {
    if (!this.metric && frames.length) this.metric = frames[0].metric;
    const shown = frames.filter(({ metric }) => metric === this.metric);
    shown.forEach((frame, index) => this.send(frame, index < shown.length - 1));
  }

  /** @param {import("../../core/replay/frames.js").Frame} frame @param {boolean} quiet */
  send({ at, payload }, quiet) {
    const number = ++this.number >>> 0;
    const message = new Uint8Array(HEAD_BYTES + payload.length);
    new DataView(message.buffer).setUint32(0, number);
    message.set(payload, HEAD_BYTES);
    this.pending.set(number, at);
    this.worker ??= this.start();
    this.worker.postMessage({ connection: this.run, message: message.buffer, quiet }, [message.buffer]);
  }

  close() {
    this.reset();
    this.worker?.terminate();
    this.worker = null;
  }

  start() {
    const worker = browser.worker(new URL("./video-worker.js", import.meta.url));
    worker.onmessage = ({ data }) => this.made(data);
    worker.onerror = (event) => this.change(`Pictures cannot be decoded here: ${event.message}`);
    return worker;
  }

  /** @param {any} made of the worker */
  made({ connection, seq, bitmap, problem, encoding, capturedMs, frame, key }) {
    try {
      const receivedMs = connection === this.run ? this.pending.get(seq) : undefined;
      if (receivedMs === undefined) return;
      this.pending.delete(seq);
      this.change(problem ?? "");
      if (!bitmap) return;
      const { width, height } = bitmap;
      this.draw(bitmap, { seq, encoding, capturedMs, frame, width, height, key, rescue: false, receivedMs });
    } finally {
      bitmap?.close();
    }
  }

  /** @param {string} problem */
  change(problem) {
    if (problem === this.problem) return;
    this.problem = problem;
    this.onProblem(problem);
  }
}

// The sound of a recording, at the speed at which it was recorded, together with its pictures.

import * as browser from "../../core/browser.js";
import { Speaker } from "../speaker.js";

const BUFFERED_MS = 65; // in the jitter buffer, and at the loudspeaker: see playout.js
const LATEST_MS = 500; // sound is not shifted further
const HEAD_BYTES = 24; // of a packet; its last eight are when it was captured
const SMOOTH = 0.1;

export class ReplaySound {
  /** @param {() => void} onChange */
  constructor(onChange) {
    this.onChange = onChange;
    this.on = false; // a person wants to listen
    this.runs = false; // the recording is played, at its own speed
    this.problem = "";
    this.packets = 0; // of the recording, since the last seek
    this.lead = BUFFERED_MS;
    this.pictureDelay = NaN; // ms from its capture to its reception
    this.soundDelay = NaN;
    /** @type {import("../playout.js").Stats | null} */
    this.stats = null;
    /** @type {Speaker | null} */
    this.speaker = null;
    /** @type {Worker | null} */
    this.worker = null;
  }

  /** To be called in a click: browsers start no sound by themselves. */
  async start() {
    this.on = true;
    this.problem = "";
    this.onChange();
    try {
      this.speaker ??= new Speaker();
      this.speaker.start();
      await this.speaker.ready();
      if (!this.on) return; // stopped meanwhile
      this.worker ??= this.open();
      this.reset();
      this.adjust();
    } catch (error) {
      this.on = false;
      this.problem = `Sound cannot be played: ${/** @type {Error} */ (error).message}`;
    }
    this.onChange();
  }

  stop() {
    this.on = false;
    this.adjust();
    this.onChange();
  }

  close() {
    this.on = false;
    this.worker?.terminate();
    this.worker = null;
    this.context?.close();
    this.speaker = null;
  }

  get context() {
    return this.speaker?.context ?? null;
  }

  /** @param {boolean} runs */
  run(runs) {
    if (runs === this.runs) return;
    this.runs = runs;
    this.adjust();
  }

  /** A seek, or another speed: what waits at the loudspeaker is not played. */
  reset() {
    this.packets = 0;
    this.stats = null;
    this.lead = this.leadNow();
    if (!this.worker || !this.speaker || !this.context) return;
    const { port1, port2 } = new MessageChannel();
    this.speaker.attach(port2);
    this.worker.postMessage({ op: "begin", port: port1, rate: this.context.sampleRate }, [port1]);
  }

  /** @param {import("../../core/replay/frames.js").Frame} frame */
  take({ at, payload }) {
    this.packets++;
    this.soundDelay = smoothed(this.soundDelay, at - capturedOf(payload));
    if (!this.on || !this.runs || !this.worker) return;
    const copy = payload.slice().buffer;
    this.worker.postMessage({ op: "take", payload: copy }, [copy]);
  }

  /** A picture was drawn. @param {number} receivedMs @param {number | null} capturedMs */
  drew(receivedMs, capturedMs) {
    const known = Number.isFinite(this.pictureDelay);
    if (capturedMs !== null) this.pictureDelay = smoothed(this.pictureDelay, receivedMs - capturedMs);
    if (!known) this.lead = this.leadNow();
  }

  /** By how many ms sound has to be delivered earlier than it was received, to be heard with its picture. */
  leadNow() {
    const { baseLatency = 0, outputLatency = 0 } = this.context ?? {};
    const later = this.pictureDelay - this.soundDelay; // a picture takes longer to arrive than sound does
    const shift = Number.isFinite(later) ? Math.max(-LATEST_MS, Math.min(LATEST_MS, later)) : 0;
    return BUFFERED_MS + 1000 * Math.max(baseLatency, outputLatency) - shift;
  }

  adjust() {
    if (this.on && this.runs) this.context?.resume();
    else this.context?.suspend();
  }

  open() {
    const worker = browser.worker(new URL("./sound-worker.js", import.meta.url));
    worker.onmessage = ({ data }) => {
      this.stats = data.stats;
      const { received, refused } = data.stats;
      const problem = received > 0 && received === refused ? "This browser cannot decode the sound; Opus needs https" : "";
      if (problem === this.problem) return;
      this.problem = problem;
      this.onChange();
    };
    return worker;
  }
}

/** @param {Uint8Array} packet @returns {number} epoch ms; NaN for what is none */
function capturedOf(packet) {
  if (packet.length < HEAD_BYTES) return NaN;
  return Number(new DataView(packet.buffer, packet.byteOffset).getBigUint64(HEAD_BYTES - 8));
}

/** @param {number} mean @param {number} value */
const smoothed = (mean, value) => {
  if (!Number.isFinite(value)) return mean;
  return Number.isFinite(mean) ? (1 - SMOOTH) * mean + SMOOTH * value : value;
};

// From packets of a robot's sound to what the loudspeaker plays next.

import { JitterBuffer } from "./jitter.js";
import { OpusDecoder } from "./opus.js";
import { Resampler } from "./resampler.js";
import { pcmOf, unpack } from "./sound-packet.js";

const TARGET_MS = 20; // in the jitter buffer, and more if packets come unevenly
const LEAD_S = 0.02; // at the loudspeaker: what the worker and its messages may be late; more on a slow machine
const LEAD_STEP_S = 0.01;
const CALM_S = 10; // without being late before the lead is lowered by one step
const LONGEST_LEAD_S = 0.12;
const SLACK_S = 0.01;
const LONGEST_TICK_S = 0.1; // the loudspeaker has stopped if it says nothing for so long

/** @typedef {{bufferedMs: number, lost: number, refused: number, encoding: string, received: number}} Stats */

export class Playout {
  /** @param {MessagePort} port of what plays @param {number} rate at which it plays */
  constructor(port, rate) {
    this.port = port;
    this.rate = rate;
    this.buffer = new JitterBuffer({ targetMs: TARGET_MS });
    this.opus = new OpusDecoder(
      (packet) => this.buffer.put(packet, this.now()),
      () => this.refused++,
    );
    this.played = this.removed = this.pushed = 0; // samples of each channel; played: with silence
    this.tickedAt = performance.now();
    this.lead = LEAD_S;
    this.calmSince = this.tickedAt;
    this.received = this.refused = 0;
    this.encoding = "";
    this.format = "";
    /** @type {Resampler[]} */
    this.resamplers = [];
    port.onmessage = ({ data }) => this.tick(data.played, data.removed);
  }

  /** @param {ArrayBuffer} payload as it came from the robot */
  take(payload) {
    this.received++;
    try {
      const sound = unpack(new Uint8Array(payload));
      if (sound.encoding === "opus") this.opus.feed(sound);
      else this.buffer.put({ ...sound, samples: pcmOf(sound) }, this.now());
      this.encoding = sound.encoding;
    } catch {
      this.refused++;
    }
  }

  /** @returns {Stats} */
  stats() {
    const { received, refused, encoding } = this;
    const waiting = this.buffer.waitingS + (this.pushed - this.removed) / this.rate;
    return { bufferedMs: Math.round(1000 * waiting), lost: this.buffer.lost, refused, encoding, received };
  }

  /** Seconds of the loudspeaker's clock. */
  now() {
    return this.played / this.rate + Math.min(LONGEST_TICK_S, (performance.now() - this.tickedAt) / 1000);
  }

  /** @param {number} played @param {number} removed */
  tick(played, removed) {
    this.played = played;
    this.removed = removed;
    this.tickedAt = performance.now();
    if (this.tickedAt - this.calmSince >= 1000 * CALM_S) this.leadBy(-LEAD_STEP_S);
    while (this.pushed - this.removed < (this.lead + SLACK_S) * this.rate) {
      const { playing } = this.buffer;
      const chunk = this.buffer.take(this.now());
      if (!chunk) return;
      if (this.pushed === this.removed) this.begin(playing);
      this.push(...this.planes(chunk));
    }
  }

  /** Nothing waits at the loudspeaker. @param {boolean} late because this worker was late */
  begin(late) {
    if (late) this.leadBy(LEAD_STEP_S);
    this.push(new Float32Array(Math.round(this.lead * this.rate)));
  }

  /** @param {number} seconds more, or less */
  leadBy(seconds) {
    this.lead = Math.max(LEAD_S, Math.min(this.lead + seconds, LONGEST_LEAD_S));
    this.calmSince = this.tickedAt;
  }

  /** @param {Float32Array} left @param {Float32Array} [right] */
  push(left, right = left) {
    this.pushed += left.length;
    this.port.postMessage({ left, right });
  }

  /**
   * One or two channels at the loudspeaker's rate.
   * @param {import("./jitter.js").Chunk} chunk @returns {[Float32Array, Float32Array?]}
   */
  planes({ samples, rate, channels }) {
    const count = channels === 2 ? 2 : 1;
    const format = `${rate} ${count}`;
    if (format !== this.format) {
      this.format = format;
      this.resamplers = Array.from({ length: count }, () => new Resampler(rate, this.rate));
    }
    const [left, right] = this.resamplers.map((resampler, channel) => resampler.feed(plane(samples, channels, channel)));
    return [left, right];
  }
}

/** One channel of two, or the mean of all. @param {Int16Array} samples @param {number} channels @param {number} channel */
function plane(samples, channels, channel) {
  return Float32Array.from({ length: samples.length / channels }, (_, frame) => {
    const at = frame * channels;
    if (channels <= 2) return samples[at + channel] / 32768;
    return samples.subarray(at, at + channels).reduce((sum, one) => sum + one, 0) / channels / 32768;
  });
}

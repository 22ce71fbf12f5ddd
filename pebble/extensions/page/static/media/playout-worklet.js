// Plays what the worker of sound pushes, and tells it how much was played: the loudspeaker's clock is the one that counts.

import { Ring } from "./ring.js";

const REPORT_FRAMES = 384; // 8 ms at 48 kHz
const LIMIT_S = 1;

class Playout extends AudioWorkletProcessor {
  constructor() {
    super();
    this.ring = new Ring(LIMIT_S * sampleRate);
    /** @type {MessagePort|null} */
    this.worker = null;
    this.played = this.reported = 0;
    this.taps = false; // what is played is also sent to the page
    this.port.onmessage = ({ data }) => {
      if (data.port) this.serve(data.port);
      if (data.taps) this.taps = true;
    };
  }

  /** @param {MessagePort} port of the worker */
  serve(port) {
    this.worker?.close();
    this.worker = port;
    this.ring = new Ring(LIMIT_S * sampleRate);
    port.onmessage = ({ data }) => this.ring.push(data.left, data.right);
  }

  /** @param {Float32Array[][]} _inputs @param {Float32Array[][]} outputs */
  process(_inputs, [[left, right]]) {
    this.ring.pull(left, right);
    this.played += left.length;
    if (this.played - this.reported >= REPORT_FRAMES) {
      this.reported = this.played;
      this.worker?.postMessage({ played: this.played, removed: this.ring.removed });
    }
    if (this.taps) this.port.postMessage({ at: currentTime, left: left.slice() });
    return true;
  }
}

registerProcessor("pebble-playout", Playout);

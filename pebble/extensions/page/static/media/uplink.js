// One talk: from the microphone's samples to numbered pieces of 20 ms for the server.

import { Resampler } from "./resampler.js";

const RATE = 16_000;
const PIECE = 320;
const HEAD_BYTES = 9; // u8 what, u32 talk, u32 number
const VOICE = 1;

export class Uplink {
  /**
   * @param {MessagePort} port of the microphone @param {number} rate of its samples @param {number} talk its number
   * @param {(message: ArrayBuffer) => void} send
   */
  constructor(port, rate, talk, send) {
    this.port = port;
    this.talk = talk;
    this.send = send;
    this.resampler = new Resampler(rate, RATE);
    this.piece = new Int16Array(PIECE);
    this.filled = this.number = 0;
    port.onmessage = ({ data }) => this.feed(data);
  }

  /** @param {Float32Array} samples */
  feed(samples) {
    for (const sample of this.resampler.feed(samples)) {
      this.piece[this.filled++] = Math.max(-32768, Math.min(32767, Math.round(32768 * sample)));
      if (this.filled === PIECE) this.flush();
    }
  }

  flush() {
    const message = new DataView(new ArrayBuffer(HEAD_BYTES + 2 * PIECE));
    message.setUint8(0, VOICE);
    message.setUint32(1, this.talk);
    message.setUint32(5, this.number++);
    this.piece.forEach((sample, index) => message.setInt16(HEAD_BYTES + 2 * index, sample, true));
    this.filled = 0;
    this.send(message.buffer);
  }

  close() {
    this.port.close();
  }
}

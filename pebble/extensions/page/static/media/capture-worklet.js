// Hands the microphone's samples to the worker of sound.

const BLOCK = 512;

class Capture extends AudioWorkletProcessor {
  constructor() {
    super();
    /** @type {MessagePort|null} */
    this.worker = null; // while a person talks
    this.block = new Float32Array(BLOCK);
    this.filled = 0;
    this.port.onmessage = ({ data }) => {
      this.worker?.close();
      this.worker = data.port;
      this.filled = 0;
    };
  }

  /** @param {Float32Array[][]} inputs */
  process([[samples]]) {
    if (!this.worker || !samples) return true;
    this.block.set(samples, this.filled);
    this.filled += samples.length;
    if (this.filled === BLOCK) {
      this.worker.postMessage(this.block);
      this.filled = 0;
    }
    return true;
  }
}

registerProcessor("pebble-capture", Capture);

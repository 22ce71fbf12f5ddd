// One channel of sound from one rate to another by a windowed sinc, without a seam between pieces; delays by about 1 ms.
//
// As pebble/extensions/media/pcm.py does it: aliases and images are below -60 dB.

const CROSSINGS = 16; // zero crossings of the filter to each side
const PASS = 0.92; // of the lower of the two Nyquist frequencies
const PHASES = 512; // at most; rates whose ratio needs more are met to 1/512 of a sample

export class Resampler {
  /** @param {number} rate @param {number} rateOut whole numbers of Hz */
  constructor(rate, rateOut) {
    const common = divisor(rate, rateOut);
    this.up = rateOut / common;
    this.down = rate / common;
    const widened = Math.max(1, this.down / this.up);
    this.taps = 2 * Math.ceil(CROSSINGS * widened);
    this.filter = filter(Math.min(this.up, PHASES), this.taps, PASS / widened);
    this.tail = new Float32Array(this.taps - 1);
    this.at = 0; // of the next output sample, from the tail's beginning, in input samples / up
  }

  /** @param {Float32Array} samples @returns {Float32Array} */
  feed(samples) {
    const { up, down, taps } = this;
    if (up === down) return samples;
    const held = new Float32Array(this.tail.length + samples.length);
    held.set(this.tail);
    held.set(samples, this.tail.length);
    const windows = held.length - taps + 1;
    const made = new Float32Array(Math.max(0, Math.ceil((windows * up - this.at) / down)));
    for (let index = 0; index < made.length; index++, this.at += down) {
      const weights = this.filter[Math.floor(((this.at % up) * this.filter.length) / up)];
      const from = Math.floor(this.at / up);
      let sum = 0;
      for (let tap = 0; tap < taps; tap++) sum += held[from + tap] * weights[tap];
      made[index] = sum;
    }
    this.at -= windows * up;
    this.tail = held.slice(windows);
    return made;
  }
}

/**
 * The low pass as it looks from each position between two input samples; each sums up to 1.
 * @param {number} phases @param {number} taps @param {number} passed
 */
function filter(phases, taps, passed) {
  return Array.from({ length: phases }, (_, phase) => {
    const shape = Float64Array.from({ length: taps }, (_, tap) => {
      const offset = tap - (taps / 2 - 1) - phase / phases;
      return sinc(offset * passed) * Math.cos(Math.PI * Math.max(-0.5, Math.min(0.5, offset / taps))) ** 2;
    });
    const sum = shape.reduce((total, weight) => total + weight);
    return Float32Array.from(shape, (weight) => weight / sum);
  });
}

/** @param {number} x */
const sinc = (x) => (x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x));

/** @param {number} a @param {number} b @returns {number} */
const divisor = (a, b) => (b ? divisor(b, a % b) : a);

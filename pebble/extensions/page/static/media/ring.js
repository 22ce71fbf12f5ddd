// The sound that waits at the loudspeaker: two channels of samples, bounded. Pure.

/** Samples of both channels, in the order in which they were pushed. */
export class Ring {
  /** @param {number} limit of samples of each channel; the oldest make room for the newest */
  constructor(limit) {
    this.limit = limit;
    /** @type {Float32Array[][]} each one left and right */
    this.pieces = [];
    this.used = 0; // of the first piece
    this.length = 0;
    this.removed = 0; // samples of each channel that were played, or made room
  }

  /** @param {Float32Array} left @param {Float32Array} right of the same length */
  push(left, right) {
    this.pieces.push([left, right]);
    this.length += left.length;
    while (this.length > this.limit && this.pieces.length > 1) this.drop(this.pieces[0][0].length - this.used);
  }

  /** Fill both channels; with silence where nothing waits. @param {Float32Array} left @param {Float32Array} right */
  pull(left, right) {
    let filled = 0;
    while (filled < left.length && this.pieces.length) {
      const [first, second] = this.pieces[0];
      const count = Math.min(left.length - filled, first.length - this.used);
      left.set(first.subarray(this.used, this.used + count), filled);
      right.set(second.subarray(this.used, this.used + count), filled);
      filled += count;
      this.drop(count);
    }
    left.fill(0, filled);
    right.fill(0, filled);
  }

  /** @param {number} count of the first piece */
  drop(count) {
    this.used += count;
    this.length -= count;
    this.removed += count;
    if (this.used < this.pieces[0][0].length) return;
    this.pieces.shift();
    this.used = 0;
  }
}

// A jitter buffer: sound as the network delivers it to sound in order, evenly, without gaps. Pure: times come in.
//
// The rules are those of pebble/extensions/media/jitter.py, which explains them; times are seconds. Packets of Opus are decoded
// before they are put here, so that theirs are concealed as those of PCM are: by the last one, backwards and forwards.

const NUMBERS = 0xffff_ffff; // 1 to 0xFFFFFFFF: 0 is not used
const BEHIND_LIMIT = 5; // packets in a row that seem old: the sender restarted, and its clock went back
const GAP_LIMIT = 1000; // of missing packets that count as lost
const BYTES_LIMIT = 4_000_000;
const ROUNDING_S = 1e-6; // of sums of durations
const PIECE_S = 0.02; // what is concealed at a time
const FADE_S = 0.005;
const DELAY_LIMIT_S = 0.2; // a caller that takes this late does not have to catch up
const WINDOW_S = 1.0; // what has been too much through a whole one was not needed
const HIGHEST_S = 0.3;
const CALM_S = 10.0; // without a late packet before the target is lowered by one step
const STEP_S = 0.01;

/**
 * @typedef {object} Samples to be played; interleaved
 * @property {Int16Array} samples
 * @property {number} rate
 * @property {number} channels
 * @property {string} encoding
 * @typedef {Samples & {sequence: number, capturedMs: number}} Packet
 * @typedef {Samples & {concealed: boolean}} Chunk
 */

/** @param {Samples} sound */
const framesOf = ({ samples, channels }) => samples.length / channels;

/** @param {Samples} sound */
const secondsOf = (sound) => framesOf(sound) / sound.rate;

/** From one number to another, in packets; negative if ``sequence`` is the older. @param {number} sequence @param {number} of */
export function ahead(sequence, of) {
  const distance = modulo(sequence - of, NUMBERS);
  return distance <= Math.floor(NUMBERS / 2) ? distance : distance - NUMBERS;
}

/** The target of how much sound waits: enough for the network's jitter, and no more. */
class Depth {
  /** @param {number} target seconds */
  constructor(target) {
    this.target = this.least = target;
    this.lowest = Infinity;
    this.windowBegan = this.calmSince = -Infinity;
  }

  /** @param {number} now */
  begin(now) {
    this.lowest = Infinity;
    this.windowBegan = this.calmSince = now;
  }

  /** @param {number} seconds @param {number} now */
  late(seconds, now) {
    this.target = Math.max(this.least, Math.min(this.target + seconds, HIGHEST_S));
    this.calmSince = now;
  }

  /** Seconds of sound to leave out now, while ``waiting`` wait; usually 0. @param {number} waiting @param {number} now */
  excess(waiting, now) {
    this.lowest = Math.min(this.lowest, waiting);
    if (now - this.calmSince >= CALM_S) {
      this.target = Math.max(this.least, this.target - STEP_S);
      this.calmSince = now;
    }
    if (now - this.windowBegan < WINDOW_S) return 0;
    const excess = this.lowest - this.target;
    this.lowest = Infinity;
    this.windowBegan = now;
    return Math.max(0, excess);
  }
}

export class JitterBuffer {
  /** @param {{limit?: number, concealmentMs?: number, targetMs?: number}} [options] */
  constructor({ limit = 48, concealmentMs = 100, targetMs = 60 } = {}) {
    this.lost = 0; // packets that never came, and those for which there was no room
    this.limit = limit;
    this.budget = concealmentMs / 1000;
    this.depth = new Depth(targetMs / 1000);
    /** @type {Map<number, Packet>} by number */
    this.waiting = new Map();
    /** @type {number|null} the number that is played next */
    this.expected = null;
    this.newestMs = 0;
    this.behind = 0;
    this.playing = false;
    this.due = 0;
    /** @type {Samples|null} */
    this.last = null;
    this.concealed = 0; // samples of each channel, since
  }

  /** Seconds of sound that wait. */
  get waitingS() {
    let sum = 0;
    for (const packet of this.waiting.values()) sum += secondsOf(packet);
    return sum;
  }

  // -- in

  /** @param {Packet} packet @param {number} now */
  put(packet, now) {
    const number = modulo(packet.sequence - 1, NUMBERS) + 1;
    if (this.isOld(number, packet.capturedMs) || this.waiting.has(number)) return;
    if (!this.playing && !this.waiting.size) this.due = now + this.depth.target;
    this.waiting.set(number, packet);
    this.newestMs = Math.max(this.newestMs, packet.capturedMs);
    this.makeRoom();
  }

  /**
   * Has this number been played or given up? If it was captured later, the sender has restarted instead.
   * @param {number} number @param {number} capturedMs
   */
  isOld(number, capturedMs) {
    if (this.expected === null || ahead(number, this.expected) >= 0) {
      this.behind = 0;
      return false;
    }
    this.behind++;
    if (capturedMs <= this.newestMs && this.behind < BEHIND_LIMIT) return true;
    this.waiting.clear();
    this.expected = null;
    this.newestMs = this.behind = 0;
    this.playing = false;
    return false;
  }

  makeRoom() {
    const bytes = () => [...this.waiting.values()].reduce((sum, { samples }) => sum + samples.byteLength, 0);
    while (this.waiting.size > 1 && (this.waiting.size > this.limit || bytes() > BYTES_LIMIT)) {
      this.waiting.delete(this.first());
      this.lost++;
      if (this.expected !== null) this.expected = this.first(); // left out on purpose: not a gap
    }
  }

  /** The first of the waiting numbers. */
  first() {
    const numbers = [...this.waiting.keys()];
    const base = this.expected ?? numbers[0];
    return numbers.reduce((first, number) => (ahead(number, base) < ahead(first, base) ? number : first));
  }

  // -- out

  /** The next chunk if it is due. @param {number} now @returns {Chunk|null} */
  take(now) {
    if (!this.playing && !this.begin(now)) return null;
    if (now < this.due) return null;
    if (now - this.due > DELAY_LIMIT_S) this.due = now;
    const chunk = this.next(now);
    if (!chunk) {
      this.playing = false;
      if (this.waiting.size) this.due = now + this.depth.target;
      return null;
    }
    this.due += secondsOf(chunk);
    return chunk;
  }

  /** @param {number} now */
  begin(now) {
    if (!this.waiting.size || now < this.due) return false;
    this.playing = true;
    this.due = now;
    this.last = null; // the silence before was not a gap
    this.concealed = 0;
    this.depth.begin(now);
    return true;
  }

  /** @param {number} now @returns {Chunk|null} */
  next(now) {
    const { last } = this;
    if (!this.waiting.size) return this.conceal(this.budget);
    const number = this.first();
    const missing = this.expected === null ? 0 : Math.max(0, ahead(number, this.expected));
    if (missing && last) {
      const concealed = this.conceal((missing * framesOf(last)) / last.rate);
      if (concealed) return concealed;
    }
    if (missing) this.lost += missing > GAP_LIMIT ? 0 : missing;
    else if (this.concealed && last) this.depth.late(this.concealed / last.rate, now);
    return this.play(number, now);
  }

  /** @param {number} number @param {number} now @returns {Chunk|null} */
  play(number, now) {
    let sound = /** @type {Samples|null} */ (this.pop(number));
    const excess = this.depth.excess(this.waitingS, now);
    if (sound && excess > secondsOf(sound) - ROUNDING_S) sound = this.leaveOut(sound, excess);
    if (!sound) return this.conceal(this.budget);
    const fadesIn = this.concealed && this.last;
    const samples = fadesIn ? mixed(sound, (sample, _, weight) => sample * weight) : sound.samples;
    this.last = sound;
    this.concealed = 0;
    return { ...sound, samples, concealed: false };
  }

  /** @param {number} number @returns {Packet|null} null: there is nothing in it */
  pop(number) {
    const packet = /** @type {Packet} */ (this.waiting.get(number));
    this.waiting.delete(number);
    this.expected = (number % NUMBERS) + 1;
    return packet.samples.length ? packet : null;
  }

  /** What to play after leaving out so much; it begins as ``sound`` does. @param {Samples} sound @param {number} excess seconds */
  leaveOut(sound, excess) {
    let newest = sound;
    for (let left = excess; this.waiting.size && left > secondsOf(newest) - ROUNDING_S; ) {
      left -= secondsOf(newest);
      newest = this.pop(this.first()) ?? newest;
    }
    return fadedOver(sound, newest);
  }

  /**
   * A piece of estimated sound, until the gap is filled or the budget is used up.
   * @param {number} gap seconds @returns {Chunk|null}
   */
  conceal(gap) {
    const { last } = this;
    if (!last) return null;
    const { samples, rate, channels } = last;
    const allowed = round(this.budget * rate);
    const size = Math.min(round(Math.min(gap, this.budget) * rate) - this.concealed, round(PIECE_S * rate));
    if (size <= 0) return null;
    const length = framesOf(last);
    const made = new Int16Array(size * channels);
    for (let frame = 0; frame < size; frame++) {
      const way = (this.concealed + frame) % (2 * length);
      const from = way < length ? length - 1 - way : way - length;
      const gain = 1 - (this.concealed + frame) / allowed;
      for (let channel = 0; channel < channels; channel++) {
        made[frame * channels + channel] = toInt16(samples[from * channels + channel] * gain);
      }
    }
    this.concealed += size;
    return { ...last, samples: made, concealed: true };
  }
}

/** @param {Samples} old @param {Samples} sound @returns {Samples} ``sound``, beginning as ``old`` does */
function fadedOver(old, sound) {
  if (old === sound || old.rate !== sound.rate || old.channels !== sound.channels) return sound;
  const samples = mixed(
    sound,
    (sample, index, weight) => old.samples[index] * (1 - weight) + sample * weight,
    framesOf(old),
  );
  return { ...sound, samples };
}

/**
 * The first samples changed, by a weight that grows from 0 to 1.
 * @param {Samples} sound @param {(sample: number, index: number, weight: number) => number} mix
 * @param {number} [limit] of frames
 */
function mixed(sound, mix, limit = Infinity) {
  const { channels, rate } = sound;
  const samples = sound.samples.slice();
  const size = Math.min(framesOf(sound), limit, round(FADE_S * rate));
  const step = 1 / (size - 1);
  for (let index = 0; index < size * channels; index++) {
    const frame = Math.floor(index / channels);
    const weight = frame && frame === size - 1 ? 1 : frame ? frame * step : 0;
    samples[index] = toInt16(mix(samples[index], index, weight));
  }
  return samples;
}

/** Halves to even, as Python does. @param {number} value */
function round(value) {
  const rounded = Math.round(value);
  return rounded - value === 0.5 && rounded % 2 !== 0 ? rounded - 1 : rounded;
}

/** @param {number} value */
const toInt16 = (value) => round(Math.max(-32768, Math.min(32767, value)));

/** @param {number} value @param {number} of */
const modulo = (value, of) => ((value % of) + of) % of;

/** Plays recorded messages: loads a little ahead, keeps the time, seeks, and leaves gaps out. No DOM. */

import { RefusedError } from "./archive.js";
import { CHAIN, INCOMING, PICTURE, SOUND, STATE } from "./frames.js";

export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];

const SEGMENT_MS = 2000;
const SEEK_MS = 500; // the first segment after a seek is short, so that its picture is soon there
const AHEAD_MS = 12_000; // of the recording: more than a step of the timeline, which says that it has a picture
const AHEAD_BYTES = 16_000_000;
const SKIP_MS = 2000; // a shorter time without messages is played
const REST_MS = 400; // after a seek, before more is loaded for a player that is paused
const FIRST_RETRY_MS = 500;
const LONGEST_RETRY_MS = 4000;
const SKIP_SHOWN_MS = 6000;
const FRAME_BYTES = 15; // of a frame besides its metric and payload

/**
 * @typedef {import("./archive.js").Segment} Segment
 * @typedef {import("./frames.js").Frame} Frame
 * @typedef {object} Parts
 * @property {(at: number, lasts: number, seek: boolean, signal: AbortSignal) => Promise<Segment>} load
 * @property {(frames: Frame[]) => void} deliver what is due, in order
 * @property {(at: number) => void} reset everything that was delivered is void: a seek has arrived
 * @property {() => void} [changed] what people see of the player is another
 * @property {() => boolean} [busy] what was delivered is still being worked at: the time stands still
 * @property {() => number} [soundLead] ms by which sound is to be delivered earlier
 * @property {() => number} [clock] ms, monotonic
 */

export class Player {
  /** @param {Parts} parts */
  constructor({ load, deliver, reset, changed, busy, soundLead, clock }) {
    this.load = load;
    this.deliver = deliver;
    this.reset = reset;
    this.changed = changed ?? (() => {});
    this.busy = busy ?? (() => false);
    this.soundLead = soundLead ?? (() => 0);
    this.clock = clock ?? (() => performance.now());
    this.position = 0; // epoch ms
    this.speed = 1;
    this.playing = false;
    this.ended = false; // nothing follows
    this.waiting = false; // for messages
    this.problem = ""; // why nothing could be loaded
    this.warning = ""; // what is wrong with what was loaded
    /** @type {{since: number, until: number, at: number} | null} the last stretch without messages; ``at``: of the clock */
    this.skipped = null;
    this.seeks = 0; // how many have arrived
    this.loads = 0; // of segments, for tests
    this.begin(0);
    this.refused = true; // until the first seek
  }

  // -- what people do

  /** @param {number} ms epoch */
  seek(ms) {
    this.begin(Math.max(0, ms));
    this.changed();
    this.tick();
  }

  play() {
    if (this.playing) return;
    this.playing = true;
    if (this.ended) this.ended = this.complete = false; // more may have been recorded meanwhile
    if (this.refused && this.problem) this.refused = false;
    this.tickedAt = this.clock();
    this.changed();
  }

  /** The next picture that is loaded, after where it is; undefined: none is. @returns {Frame | undefined} */
  get nextPicture() {
    return this.frames.find(({ at, flags }) => at > this.position && flags & PICTURE && !(flags & INCOMING));
  }

  /** Paused, and a little later, with all that happened meanwhile. @param {number} ms epoch, of what is loaded */
  go(ms) {
    this.pause();
    this.ended = false;
    this.position = Math.max(this.position, Math.min(ms, this.loadedTo));
    this.jumps = this.jumps.filter(({ to }) => to > this.position);
    this.handOver();
    this.changed();
  }

  pause() {
    if (!this.playing) return;
    this.playing = this.waiting = false;
    this.changed();
  }

  /** @param {number} speed one of SPEEDS */
  setSpeed(speed) {
    if (!SPEEDS.includes(speed) || speed === this.speed) return;
    this.tick();
    this.speed = speed;
    this.changed();
  }

  close() {
    this.playing = false;
    this.refused = true;
    this.abort.abort();
    this.frames = [];
    this.sounds = [];
    this.bytes = 0;
  }

  // -- what happens by itself, to be called some fifty times a second

  tick() {
    const now = this.clock();
    const elapsed = Math.max(0, now - this.tickedAt);
    this.tickedAt = now;
    if (this.playing && !this.seeking && !this.busy()) this.advance(elapsed * this.speed, now);
    if (!this.seeking) this.handOver();
    this.fill(now);
    if (this.skipped && now - this.skipped.at > SKIP_SHOWN_MS) {
      this.skipped = null;
      this.changed();
    }
  }

  /** How much of the recording is here, in ms, without what is left out. */
  get ahead() {
    const left = this.jumps.reduce((sum, { at, to }) => sum + (to - at), 0);
    return this.loadedTo - this.position - left;
  }

  get seeking() {
    return this.seekPending;
  }

  /** @param {number} at everything begins anew there */
  begin(at) {
    this.abort?.abort();
    this.abort = new AbortController();
    this.loading = false;
    this.position = at;
    this.loadedTo = at;
    this.seekPending = true;
    this.complete = false; // all that follows is here
    this.refused = false;
    this.ended = false;
    this.waiting = false;
    this.problem = "";
    this.warning = "";
    this.skipped = null;
    /** @type {Frame[]} */
    this.frames = [];
    /** @type {Frame[]} */
    this.sounds = [];
    this.bytes = 0;
    this.largest = 0; // bytes of a segment
    this.lastAt = at; // of what is loaded
    /** @type {{at: number, to: number, since: number}[]} */
    this.jumps = [];
    this.retryAt = -Infinity;
    this.retryMs = FIRST_RETRY_MS;
    this.soughtAt = this.tickedAt = this.clock();
  }

  /** @param {number} ms of the recording @param {number} now */
  advance(ms, now) {
    const to = this.position + ms;
    const [jump] = this.jumps;
    if (jump && to >= jump.at) {
      this.position = jump.at;
      this.handOver();
      this.jumps.shift();
      this.position = jump.to;
      this.skipped = { since: jump.since, until: jump.to, at: now };
      this.changed();
      return;
    }
    this.position = Math.max(this.position, Math.min(to, this.loadedTo));
    const starved = to >= this.loadedTo;
    if (starved && this.complete) {
      this.playing = this.waiting = false;
      this.ended = true;
      this.changed();
    } else if (starved !== this.waiting) {
      this.waiting = starved;
      this.changed();
    }
  }

  handOver() {
    const lead = this.playing && this.speed === 1 ? this.soundLead() : 0;
    const due = [...this.taken(this.frames, this.position), ...this.taken(this.sounds, this.position + lead)];
    if (due.length) this.deliver(due);
  }

  /** @param {Frame[]} queue @param {number} until @returns {Frame[]} */
  taken(queue, until) {
    let count = 0;
    while (count < queue.length && queue[count].at <= until) count++;
    const taken = queue.splice(0, count);
    for (const frame of taken) this.bytes -= sizeOf(frame);
    return taken;
  }

  /** @param {number} now */
  fill(now) {
    if (this.loading || this.refused || this.complete || now < this.retryAt) return;
    if (!this.seekPending) {
      if (!this.playing && now - this.soughtAt < REST_MS) return;
      if (this.ahead + SEGMENT_MS > AHEAD_MS) return;
      if (this.bytes > 0 && this.bytes + this.largest > AHEAD_BYTES) return;
    }
    this.request();
  }

  async request() {
    const { abort, seekPending: seek } = this;
    const from = seek ? this.position : this.loadedTo;
    this.loading = true;
    this.loads++;
    try {
      const segment = await this.load(from, seek ? SEEK_MS : SEGMENT_MS, seek, abort.signal);
      if (abort !== this.abort || abort.signal.aborted) return;
      this.loading = false;
      this.arrived(segment, from, seek);
    } catch (error) {
      if (abort !== this.abort || abort.signal.aborted) return;
      this.loading = false;
      this.failed(/** @type {Error} */ (error));
    }
  }

  /** @param {Segment} segment @param {number} from @param {boolean} seek */
  arrived(segment, from, seek) {
    const before = segment.frames.filter(isBefore);
    const after = segment.frames.filter((frame) => !isBefore(frame)).sort((a, b) => a.at - b.at);
    this.problem = "";
    this.retryMs = FIRST_RETRY_MS;
    this.warning = segment.problem || (segment.complete ? "" : "Pictures are missing here: there were too many for one answer");
    this.largest = Math.max(this.largest, segment.bytes);
    for (const frame of after) {
      (frame.flags & SOUND ? this.sounds : this.frames).push(frame);
      this.bytes += sizeOf(frame);
    }
    this.lastAt = after.at(-1)?.at ?? this.lastAt;
    this.follow(segment, after.length ? segment.until : from);
    if (seek) {
      this.seekPending = false;
      this.seeks++;
      this.tickedAt = this.clock();
      this.reset(this.position);
      this.deliver(before);
      this.handOver();
    }
    this.changed();
  }

  /** @param {Segment} segment @param {number} end of what it has */
  follow({ next, until }, end) {
    if (next === null) {
      this.complete = true;
      this.loadedTo = Math.max(this.lastAt, this.position);
    } else {
      if (next - until >= SKIP_MS) this.jumps.push({ at: end, to: next, since: this.lastAt });
      this.loadedTo = next;
    }
  }

  /** @param {Error} error */
  failed(error) {
    this.refused = error instanceof RefusedError;
    this.problem = error.message;
    this.retryAt = this.clock() + this.retryMs;
    this.retryMs = Math.min(LONGEST_RETRY_MS, 2 * this.retryMs);
    if (this.refused) this.playing = this.waiting = false;
    this.changed();
  }
}

/** @param {Frame} frame */
const isBefore = ({ flags }) => (flags & (STATE | CHAIN)) !== 0;

/** @param {Frame} frame */
const sizeOf = ({ metric, payload }) => FRAME_BYTES + metric.length + payload.length;

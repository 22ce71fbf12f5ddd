/**
 * Motion belongs to a gesture: from the moment the inputs leave neutral until they are released. Pure: no DOM, no clock.
 *
 * What interrupts a gesture ends it for good. Inputs that are still held then move nothing before they were released.
 */

export const PERIOD_MS = 50;
export const STALL_MS = 250;
const STEP_MS = 20; // at least, between two commands
const EARLY_MS = 15; // a timer may be: without it every second command would be missing
const REPEATS_MS = [50, 100]; // after a release, the zero is sent again
const SUSPENDED_MS = 500; // between the wall clock and the page's own

/** @typedef {{x: number, z: number, y: number}} Vector */
/** @typedef {Vector & {g: number, t: number, final: boolean}} Command */

export class Gesture {
  /** @param {(command: Command) => void} send */
  constructor(send) {
    this.send = send;
    this.number = 0; // of the newest gesture, counted per connection
    this.active = false;
    this.mustRelease = false; // inputs are held that may not begin a gesture
    this.last = ZERO;
    this.sentAt = -Infinity;
    this.updatedAt = -Infinity;
    /** @type {number[]} */
    this.repeats = [];
    this.final = false;
  }

  /**
   * To be called on every change of the inputs, and every 50 ms.
   * @param {Vector} vector what the inputs ask for now
   * @param {boolean} allowed whether anything may be moved now
   * @param {number} now milliseconds
   * @param {boolean} neutral whether everything is released: the vector is also 0 while opposite keys are held
   * @param {boolean} waits whether something is held that may not begin a gesture
   */
  update(vector, allowed, now, neutral = isZero(vector), waits = false) {
    const moving = !isZero(vector);
    const stalled = now - this.updatedAt > STALL_MS;
    this.updatedAt = now;
    if (this.active && (stalled || !allowed)) this.interrupt(now);
    else if (this.active && !moving) this.end(now, false);
    else if (this.active) this.step(vector, now);
    else if (neutral) this.mustRelease = false;
    else if (!allowed || waits) this.mustRelease = true;
    else if (moving && !this.mustRelease) this.begin(vector, now);
    this.repeat(now);
  }

  /** Something other than the driver ends the gesture: it stops, and held inputs are ignored until they are released. */
  interrupt(now) {
    if (this.active) this.end(now, true);
    this.mustRelease = true;
  }

  /** The server has ended gesture ``g``, and has stopped what it moved. @returns {boolean} whether it lasted until now */
  refused(g) {
    if (!this.active || g !== this.number) return false;
    this.active = false;
    this.mustRelease = true;
    this.last = ZERO;
    return true;
  }

  /** A new connection counts from the beginning; what was under way is over. */
  reset() {
    this.mustRelease = this.mustRelease || this.active;
    this.active = false;
    this.number = 0;
    this.last = ZERO;
    this.repeats = [];
  }

  begin(vector, now) {
    this.number += 1;
    this.active = true;
    this.repeats = [];
    this.command(vector, now, false);
  }

  step(vector, now) {
    const changed = vector.x !== this.last.x || vector.z !== this.last.z || vector.y !== this.last.y;
    if (now - this.sentAt >= (changed ? STEP_MS : PERIOD_MS - EARLY_MS)) this.command(vector, now, false);
  }

  end(now, final) {
    this.active = false;
    this.final = final;
    this.command(ZERO, now, final);
    this.repeats = REPEATS_MS.map((after) => now + after);
  }

  repeat(now) {
    if (this.active || !this.repeats.length || this.repeats[0] > now) return;
    const late = now - this.repeats[0] > STALL_MS; // in the background: meanwhile another page may drive, and be stopped
    this.repeats = this.repeats.filter((at) => at > now);
    if (!late) this.command(ZERO, now, this.final);
  }

  command(vector, now, final) {
    this.last = vector;
    this.sentAt = now;
    this.send({ g: this.number, x: round(vector.x), z: round(vector.z), y: round(vector.y), t: now, final });
  }
}

/** @type {Vector} */
export const ZERO = Object.freeze({ x: 0, z: 0, y: 0 });

function isZero({ x, z, y }) {
  return x === 0 && z === 0 && y === 0;
}

function round(value) {
  return Math.round(value * 1000) / 1000;
}

/** Notices that the page, or the whole machine, stood still: releases of keys may have been lost. */
export class PageClock {
  /** @param {number} now performance.now() @param {number} wall Date.now() */
  constructor(now = performance.now(), wall = Date.now()) {
    this.lookedAt = -Infinity;
    this.base = wall - now;
  }

  /**
   * Look at both clocks. Where the page's own stands still while the machine is suspended, only the other one shows it.
   * @param {number} now @param {number} wall @returns {"" | "stalled" | "suspended"}
   */
  look(now, wall = Date.now()) {
    const stalled = now - this.lookedAt > STALL_MS;
    const jump = Math.abs(wall - now - this.base);
    this.lookedAt = now;
    this.base = wall - now;
    return jump > SUSPENDED_MS ? "suspended" : stalled ? "stalled" : "";
  }
}

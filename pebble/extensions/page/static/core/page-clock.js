/** Notices that the page, or the whole machine, stood still: releases of keys may have been lost. Pure. */

import { STALL_MS } from "./gesture.js";

const SUSPENDED_MS = 500; // between the wall clock and the page's own

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

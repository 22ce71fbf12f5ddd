/** Whether people were told that a component is there, by its recorded heartbeats and link: RobotView.online. Pure. */

import { isObject } from "../json.js";

const HISTORY = 10;
const STAMPS = 5;
const LEAST_MS = 50; // between two heartbeats
const LONGEST_MS = 10_000;
const SILENT_MS = 1500; // a silence of less is none
const ON_LINK_MS = new Map([["narrow", 3000], ["thin", 5000]]); // nor is one of less there: pebble.contract.levels

export class Heartbeats {
  constructor() {
    this.receivedAt = -Infinity;
    this.offline = false;
    /** @type {number[]} */
    this.intervals = [];
    /** @type {number[]} */
    this.latencies = [];
    /** @type {number | null} */
    this.latency = null; // of the newest heartbeat; null if its clock is wrong
    /** @type {number[]} */
    this.stamps = [];
    this.link = "wide";
  }

  /** @param {unknown} payload of the metric "link"; undefined: it was removed */
  receiveLink(payload) {
    this.link = isObject(payload) ? payload.level : "wide";
  }

  /** @param {number} at when it was received @param {unknown} payload of the metric "online" */
  receive(at, payload) {
    const interval = at - this.receivedAt;
    if (interval >= LEAST_MS && interval <= LONGEST_MS) push(this.intervals, interval, HISTORY);
    const t = isObject(payload) && Number.isFinite(payload.t) ? payload.t : NaN;
    const late = at - t;
    this.latency = late >= -1000 && late <= LONGEST_MS ? Math.max(0, late) : null;
    if (this.latency !== null) push(this.latencies, this.latency, HISTORY);
    if (t > 0) push(this.stamps, t, STAMPS);
    this.receivedAt = at;
    this.offline = isObject(payload) && payload.online === false;
  }

  /** @param {number} now @returns {import("../../messages.js").Liveness} as the server shows it of a live one */
  view(now) {
    return {
      online: this.online(now),
      silent_s: this.receivedAt === -Infinity ? null : Math.max(0, now - this.receivedAt) / 1000,
      latency_ms: this.latency,
      average_latency_ms: mean(this.latencies),
      interval_ms: mean(this.intervals),
      whole_seconds: this.stamps.length === STAMPS && this.stamps.every((stamp) => stamp % 1000 === 0),
    };
  }

  /** @param {number} now @returns {boolean | null} null: too few heartbeats to decide */
  online(now) {
    if (this.offline) return false;
    const interval = mean(this.intervals);
    if (this.intervals.length < 2 || interval === null) return null;
    const silent = Math.max(2 * interval, 4 * (mean(this.latencies) ?? 0), ON_LINK_MS.get(this.link) ?? SILENT_MS);
    return now - this.receivedAt <= silent;
  }
}

const push = (list, value, most) => list.push(value) > most && list.shift();

/** @param {number[]} values @returns {number | null} */
const mean = (values) => (values.length ? values.reduce((sum, one) => sum + one, 0) / values.length : null);

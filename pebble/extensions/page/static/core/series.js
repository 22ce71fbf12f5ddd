/** One metric over time. Pure: times are passed in, in ms of the page's clock. */

import { isObject } from "./json.js";

const GAP_MS = 2000; // at least so long without a value is a gap
const GAP_PERIODS = 3.5;
const SHOWN_PERIODS = 20; // from which the usual time between two values is taken

/** @typedef {Record<string, number>} Row */

export class Series {
  /**
   * @param {(payload: unknown) => Row | null} pick what is remembered of a payload; null: nothing
   * @param {{spanMs: number, most: number, differs?: (row: Row, last: Row, ms: number) => boolean}} limits
   * ``differs``: whether a row is worth remembering, so long after the last one
   */
  constructor(pick, { spanMs, most, differs = () => true }) {
    this.pick = pick;
    this.spanMs = spanMs;
    this.most = most;
    this.differs = differs;
    /** @type {number[]} */
    this.times = [];
    /** @type {Row[]} */
    this.rows = [];
    /** Counts what has changed. */
    this.version = 0;
    this.until = -Infinity; // what is older was forgotten
    /** @type {Row | null} */
    this.newest = null; // also if it was not worth remembering
    this.newestAt = -Infinity;
  }

  /** Forget everything: time has jumped, perhaps back. */
  restart() {
    this.clear(-Infinity);
    this.newest = null;
    this.newestAt = -Infinity;
  }

  /** Forget everything that is older. @param {number} at */
  clear(at) {
    this.times = [];
    this.rows = [];
    this.until = at;
    this.version++;
  }

  /** Take a value; a new connection sends the newest one again. @param {number} at @param {unknown} payload */
  push(at, payload) {
    const row = this.pick(payload);
    if (!row || at <= this.newestAt || at <= this.until) return;
    this.newest = row;
    this.newestAt = at;
    this.version++;
    const last = this.rows.at(-1);
    if (last && !this.differs(row, last, at - this.times[this.times.length - 1])) return;
    this.times.push(at);
    this.rows.push(row);
    this.trim(at);
  }

  /** @param {number} now */
  trim(now) {
    let count = Math.max(0, this.times.length - this.most);
    while (count < this.times.length && this.times[count] < now - this.spanMs) count++;
    if (count < this.most / 16) return; // it moves all that remains
    this.times.splice(0, count);
    this.rows.splice(0, count);
  }

  /** How long without a value is a gap. */
  get gapMs() {
    const times = this.times.slice(-SHOWN_PERIODS);
    const periods = times.slice(1).map((at, index) => at - times[index]);
    periods.sort((a, b) => a - b);
    return Math.max(GAP_MS, GAP_PERIODS * (periods[periods.length >> 1] ?? 0));
  }

  /**
   * Times and the values of some fields in [from, to], with nulls in gaps.
   * @param {string[]} fields @param {number} from @param {number} to @returns {[number[], ...(number | null)[][]]}
   */
  columns(fields, from, to) {
    /** @type {number[]} */
    const times = [];
    /** @type {(number | null)[][]} */
    const columns = fields.map(() => []);
    const { gapMs } = this;
    let index = this.times.length;
    while (index > 0 && this.times[index - 1] >= from) index--;
    for (index = Math.max(0, index - 1); index < this.times.length && this.times[index] <= to; index++) {
      const at = this.times[index];
      const before = times.at(-1);
      if (before !== undefined && at - before > gapMs) {
        times.push(before + 1);
        for (const column of columns) column.push(null);
      }
      times.push(at);
      fields.forEach((field, number) => columns[number].push(this.rows[index][field] ?? null));
    }
    return [times, ...columns];
  }
}

// -- numbers of a payload

const MOST_FIELDS = 24;
const DEPTH = 3;
const LONGEST_NAME = 60;
const LONGEST_LIST = 8;
const STAMPS = new Set(["t", "timestamp", "seq", "mcu_ms"]); // of the envelope

/** All numbers of a payload by their place in it, "gyro_dps.x"; "value" if it is one. @param {unknown} payload @returns {Row | null} */
export function numbers(payload) {
  /** @type {Row} */
  const row = Object.create(null);
  const value = isObject(payload) && "value" in payload ? payload.value : payload;
  if (typeof value === "number") collect(row, "value", value, 0);
  else if (typeof value === "object" && value !== null) {
    for (const [key, one] of entries(value)) {
      if (value !== payload || !STAMPS.has(key)) collect(row, key, one, 1);
    }
  }
  return Object.keys(row).length ? row : null;
}

/** @param {Row} row @param {string} name @param {unknown} value @param {number} depth */
function collect(row, name, value, depth) {
  if (name.length > LONGEST_NAME || Object.keys(row).length >= MOST_FIELDS) return;
  if (typeof value === "number" && Number.isFinite(value)) row[name] = value;
  else if (typeof value === "object" && value !== null && depth < DEPTH) {
    for (const [key, one] of entries(value)) collect(row, `${name}.${key}`, one, depth + 1);
  }
}

/** @param {object} value @returns {[string, unknown][]} */
function entries(value) {
  const all = Object.entries(value);
  return all.slice(0, Array.isArray(value) ? LONGEST_LIST : 4 * MOST_FIELDS);
}

// Any JSON value as lines of text, nested ones below and farther in. Pure.

import { plain } from "../parts/more-words.js";
import { isObject } from "../parts/words.js";

export const MAX_LINES = 100;
export const MAX_DEPTH = 4; // deeper ones are put into one line
const LONG = 80; // characters of a key
const WRAPPERS = new Set(["t", "timestamp"]); // what nearly all payloads have besides their value

/** @typedef {{depth: number, key: string, text: string}} Line */

/** The lines of a payload; ``omitted`` counts those beyond the limit, as far as they were looked for. */
export class Lines {
  /** @param {unknown} payload */
  constructor(payload) {
    /** @type {Line[]} */
    this.lines = [];
    this.omitted = 0;
    if (isObject(payload) && "value" in payload) this.addWrapped(payload);
    else this.add("", payload, 0);
  }

  /** ``value`` comes first and needs no name. @param {Record<string, unknown>} payload */
  addWrapped({ value, unit, ...others }) {
    const isPlain = typeof value !== "object" || value === null;
    const withUnit = isPlain && typeof unit === "string" && unit !== "";
    this.add("", withUnit ? `${plain(value)} ${unit}` : value, 0);
    if (!withUnit && unit !== undefined) this.add("unit", unit, 0);
    this.addEntries(Object.entries(others).filter(([key]) => !WRAPPERS.has(key)), 0);
  }

  /** @param {string} key @param {unknown} value @param {number} depth */
  add(key, value, depth) {
    if (typeof value !== "object" || value === null || depth >= MAX_DEPTH || isShort(value)) {
      this.push(key, plain(value), depth);
      return;
    }
    if (key) this.push(key, "", depth);
    this.addEntries(Object.entries(value), key ? depth + 1 : depth);
  }

  /** @param {[string, unknown][]} entries @param {number} depth */
  addEntries(entries, depth) {
    for (const [index, [key, value]] of entries.entries()) {
      if (this.lines.length >= MAX_LINES) {
        this.omitted += entries.length - index;
        return;
      }
      this.add(key, value, depth);
    }
  }

  push(key, text, depth) {
    const short = key.length > LONG ? `${key.slice(0, LONG)}…` : key;
    this.lines.push({ depth, key: short, text });
  }
}

/** What needs no lines of its own: nothing in it, or a few numbers and words. @param {object} value */
function isShort(value) {
  const entries = Object.values(value);
  if (!entries.length) return true;
  return Array.isArray(value) && entries.length <= 16 && entries.every((one) => typeof one !== "object" || one === null);
}

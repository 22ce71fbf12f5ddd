// Any JSON value as lines of text, nested ones below and farther in. Pure.

import { plain } from "../parts/more-words.js";
import { isObject } from "../parts/words.js";

const MAX_LINES = 100;
const MAX_DEPTH = 4; // deeper ones are put into one line
const LONG = 80; // characters of a key

/** @typedef {{depth: number, key: string, text: string}} Line */

/** The lines of a payload, its ``value`` first and without a name. @param {any} payload @returns {{lines: Line[], omitted: number}} */
export function linesOf(payload) {
  const all = isObject(payload) && "value" in payload ? wrapped(payload) : lines("", payload, 0);
  return { lines: all.slice(0, MAX_LINES), omitted: Math.max(0, all.length - MAX_LINES) };
}

/** Without the time that nearly all payloads have. @param {Record<string, any>} payload */
function wrapped({ value, unit, t: _t, timestamp: _timestamp, ...others }) {
  const isMeasured = !isNested(value) && typeof unit === "string" && unit !== "";
  const rest = isMeasured || unit === undefined ? others : { unit, ...others };
  const first = isMeasured ? `${plain(value)} ${unit}` : value;
  return [...lines("", first, 0), ...Object.entries(rest).flatMap(([key, one]) => lines(key, one, 0))];
}

/** @param {string} key @param {unknown} value @param {number} depth @returns {Line[]} */
function lines(key, value, depth) {
  const name = key.length > LONG ? `${key.slice(0, LONG)}…` : key;
  if (!isNested(value) || depth >= MAX_DEPTH || isShort(value)) return [{ depth, key: name, text: plain(value) }];
  const inside = Object.entries(value).flatMap(([inner, one]) => lines(inner, one, key ? depth + 1 : depth));
  return key ? [{ depth, key: name, text: "" }, ...inside] : inside;
}

const isNested = (value) => typeof value === "object" && value !== null;

/** What needs no lines of its own: nothing in it, or a few numbers and words. @param {object} value */
function isShort(value) {
  const entries = Object.values(value);
  return !entries.length || (Array.isArray(value) && entries.length <= 16 && !entries.some(isNested));
}

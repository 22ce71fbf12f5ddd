/** Log lines of one component as the page keeps and filters them. Everything in them is of a robot: any JSON. Pure. */

import { isObject } from "./json.js";

export const MOST = 500;
const LONGEST = 4000; // characters of a line
const NAME = 64; // characters of a service or logger
const SERVICES = 60; // in the list to choose from

/** From the least to the most important. */
export const LEVELS = ["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"];
/** @type {Record<string, string>} */
const SYNONYMS = { WARN: "WARNING", ERR: "ERROR", FATAL: "CRITICAL", TRACE: "DEBUG", NOTICE: "INFO" };

/**
 * ``number`` grows with each line, ``t`` is epoch ms or null. ``gap``: stands where lines are missing, whatever is
 * filtered.
 * @typedef {{number: number, t: number | null, level: string, rank: number, service: string, text: string,
 *   gap: boolean}} Line
 * @typedef {{rank: number, service: string, search: string}} Filter
 */

/** The newest lines of one component. */
export class LogBook {
  constructor() {
    /** @type {Line[]} oldest first */
    this.lines = [];
    this.cut = false; // there were older ones
    this.origin = "";
    this.last = 0; // number of the newest line at the server
    this.count = 0; // of all lines ever taken: gives each one its own number, whatever the server's count
    /** @type {Set<string>} */
    this.services = new Set();
  }

  /** Forget what is shown; what arrives later is shown again. */
  clear() {
    this.lines = [];
    this.cut = false;
  }

  /**
   * Take lines of the server, with the number of the first. What was taken before is not taken again.
   * @param {{origin: string, first: number, lines: readonly unknown[]}} message
   */
  take({ origin, first, lines }) {
    if (!this.origin) this.cut = first > 1;
    else if (origin !== this.origin) this.lines.push(gap(++this.count, "… lines may be missing here"));
    else if (first > this.last + 1) this.lines.push(gap(++this.count, dropped(first - this.last - 1)));
    if (origin !== this.origin) this.last = 0;
    this.origin = origin;
    lines.forEach((raw, index) => {
      if (first + index <= this.last) return;
      const line = lineOf(raw, ++this.count);
      this.lines.push(line);
      if (line.service && this.services.size < SERVICES) this.services.add(line.service);
    });
    this.last = Math.max(this.last, first + lines.length - 1);
    const surplus = this.lines.length - MOST;
    if (surplus > 0) {
      this.lines.splice(0, surplus);
      this.cut = true;
    }
  }

  /** @param {Filter} filter @returns {Line[]} */
  filtered(filter) {
    const search = filter.search.trim().toLowerCase();
    if (!filter.rank && !filter.service && !search) return this.lines;
    return this.lines.filter((line) => matches(line, filter, search));
  }
}

/** @param {Line} line @param {Filter} filter @param {string} search in lower case */
function matches(line, filter, search) {
  if (line.gap) return true;
  if (line.rank < filter.rank) return false;
  if (filter.service && !isOf(line.service, filter.service) && !isAbout(line, filter.service)) return false;
  return !search || `${line.service} ${line.text}`.toLowerCase().includes(search);
}

/** A service's own lines, and those of its parts: ``serial_mcu_bridge:imu``. */
const isOf = (service, wanted) => service === wanted || service.startsWith(`${wanted}:`);

/** What the launcher says of it: how it ended, and when it is started again. */
const isAbout = ({ service, text }, wanted) => service === "launcher" && text.startsWith(wanted);

/**
 * @param {unknown} raw a record, a record in a ``value``, or plain text
 * @param {number} number @returns {Line}
 */
export function lineOf(raw, number) {
  const record = recordOf(raw);
  const level = levelOf(record.level);
  const service = name(record.service);
  let text = cut(words(record.message ?? record.msg ?? record.value ?? (isObject(raw) ? raw : "")), LONGEST);
  if (service && text.startsWith(`[${service}] `)) text = text.slice(service.length + 3); // it is shown beside it
  return { number, t: stampOf(record), level, rank: rankOf(level), service, text, gap: false };
}

/** @param {number} number @param {string} text @returns {Line} */
const gap = (number, text) => ({ number, t: null, level: "", rank: 0, service: "", text, gap: true });

const dropped = (count) => `… ${count} ${count === 1 ? "line was" : "lines were"} dropped`;

/** @param {unknown} raw @returns {Record<string, any>} */
function recordOf(raw) {
  let record = raw;
  for (let depth = 0; depth < 3 && isObject(record) && !hasText(record) && isObject(record.value); depth++) {
    record = { ...record, value: undefined, ...record.value };
  }
  return isObject(record) ? record : { message: raw };
}

const hasText = (record) => record.message !== undefined || record.msg !== undefined;

/** @param {unknown} level @returns {string} "" if there is none */
function levelOf(level) {
  const text = name(level).toUpperCase().slice(0, 12);
  return Object.hasOwn(SYNONYMS, text) ? SYNONYMS[text] : text;
}

/** What is unknown counts as INFO: it must not be lost among details. */
const rankOf = (level) => (LEVELS.includes(level) ? LEVELS.indexOf(level) : 1);

/** @returns {number | null} epoch ms */
function stampOf(record) {
  const t = Number.isFinite(record.t) ? record.t : Number.isFinite(record.timestamp) ? 1000 * record.timestamp : NaN;
  return t > 0 && t < 8.6e15 ? t : null;
}

const name = (value) => (typeof value === "string" || typeof value === "number" ? cut(String(value), NAME) : "");

const words = (value) => (typeof value === "string" ? value : (JSON.stringify(value) ?? ""));

const cut = (text, most) => (text.length > most ? `${text.slice(0, most)}…` : text);

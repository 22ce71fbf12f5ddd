/** Which part of a day is seen, and where in it things are. Pure: times are epoch ms, places are pixels. */

export const DAY_MS = 86_400_000;
export const LEAST_MS = 60_000;

const TICKS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200].map((s) => 1000 * s);

/** Rows of activity, with the bits of /archive/timeline. */
export const ROWS = [
  { bit: 1, id: "online", title: "Online" },
  { bit: 2, id: "drive", title: "Driven" },
  { bit: 64, id: "video", title: "Pictures" },
  { bit: 128, id: "sound", title: "Sound" },
  { bit: 16, id: "script", title: "Script" },
  { bit: 32, id: "warning", title: "Warnings" },
];

/** @param {string} day "2026-11-22" @returns {number} its beginning; days are UTC */
export const startOf = (day) => Date.parse(`${day}T00:00:00Z`);

/** @param {number} ms @returns {string} */
export const dayOf = (ms) => new Date(ms).toISOString().slice(0, 10);

/** The part of the day that is seen. */
export class View {
  /** @param {string} day */
  constructor(day) {
    this.start = startOf(day);
    this.end = this.start + DAY_MS;
    this.from = this.start;
    this.to = this.end;
  }

  get span() {
    return this.to - this.from;
  }

  /** @param {number} ms @param {number} width @returns {number} */
  x(ms, width) {
    return ((ms - this.from) / this.span) * width;
  }

  /** @param {number} x @param {number} width @returns {number} */
  at(x, width) {
    return this.from + (x / width) * this.span;
  }

  /** @param {number} from @param {number} span */
  show(from, span) {
    const wide = Math.min(DAY_MS, Math.max(LEAST_MS, span));
    this.from = Math.min(this.end - wide, Math.max(this.start, from));
    this.to = this.from + wide;
  }

  /** @param {number} factor above 1: nearer @param {number} around ms that stays where it is */
  zoom(factor, around) {
    const span = Math.min(DAY_MS, Math.max(LEAST_MS, this.span / factor));
    this.show(around - ((around - this.from) / this.span) * span, span);
  }

  /** @param {number} ms */
  move(ms) {
    this.show(this.from + ms, this.span);
  }

  /** Turn the page once ``ms`` has left it; returns whether it did. @param {number} ms */
  follow(ms) {
    if (ms >= this.from && ms < this.to) return false;
    this.show(ms - this.span / 20, this.span);
    return true;
  }

  /**
   * Round times, not nearer than ``apart`` pixels.
   * @param {number} width @param {number} apart @param {number} offset ms from UTC to the clock on the wall
   * @returns {{at: number, step: number}[]}
   */
  ticks(width, apart, offset = 0) {
    const step = TICKS.find((one) => (one / this.span) * width >= apart) ?? TICKS[TICKS.length - 1];
    const found = [];
    const first = Math.ceil((this.from + offset) / step) * step - offset;
    for (let at = first; at < this.to; at += step) found.push({ at, step });
    return found;
  }
}

/**
 * What each column of pixels shows: the bits of its steps together.
 * @param {import("./archive.js").Timeline} timeline @param {View} view @param {number} width
 * @returns {Uint8Array}
 */
export function columns(timeline, view, width) {
  const { from, step, activity } = timeline;
  const bits = new Uint8Array(width);
  const first = Math.max(0, Math.floor((view.from - from) / step));
  const last = Math.min(activity.length - 1, Math.floor((view.to - from) / step));
  for (let index = first; index <= last; index++) {
    const at = from + index * step;
    const left = Math.max(0, Math.floor(view.x(at, width)));
    const right = Math.min(width, Math.max(left + 1, Math.floor(view.x(at + step, width))));
    for (let x = left; x < right; x++) bits[x] |= activity[index];
  }
  return bits;
}

const MARGIN = 0.04; // of what is seen

/** What of a day is worth being seen first. @param {import("./archive.js").Timeline} timeline @param {View} view @returns {[number, number]} from, span */
export function extentOf({ from, step, activity }, view) {
  const first = activity.findIndex((bits) => bits !== 0);
  if (first < 0) return [view.start, DAY_MS];
  const span = step * (activity.findLastIndex((bits) => bits !== 0) + 1 - first);
  return [from + first * step - MARGIN * span, (1 + 2 * MARGIN) * span];
}

/** @param {{since: number, until: number}[]} list @param {number} ms @returns {any} the one that holds this time */
export const holding = (list, ms) => list.find(({ since, until }) => ms >= since && ms < until);

/**
 * What is exported: what was marked, else the session at that time, else a minute.
 * @param {number | null} marked in @param {number | null} end out
 * @param {{since: number, until: number}[]} sessions @param {number} ms
 */
export function stretchOf(marked, end, sessions, ms) {
  const session = holding(sessions, marked ?? end ?? ms);
  const since = marked ?? (session && (end === null || session.since < end) ? session.since : (end ?? ms + 60_000) - 60_000);
  const until = end ?? (session && session.until > since ? session.until : since + 60_000);
  return { since, until };
}

const PICTURE_BIT = 64;

/**
 * Where the first picture of a session is; its begin if it has none.
 * @param {import("./archive.js").Timeline} timeline @param {{since: number, until: number}} session
 */
export function firstPictureOf({ from, step, activity }, { since, until }) {
  const first = Math.max(0, Math.floor((since - from) / step));
  const last = Math.min(activity.length, Math.ceil((until - from) / step));
  for (let index = first; index < last; index++) if (activity[index] & PICTURE_BIT) return Math.max(since, from + index * step);
  return since;
}

/** What was said of a stretch without messages. @param {{since: number, until: number, why?: string}[]} gaps @param {{since: number, until: number}} skipped */
export const whyOf = (gaps, { since, until }) => gaps.find((gap) => gap.since < until && gap.until > since)?.why ?? "";

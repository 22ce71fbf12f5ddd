/** What a day of a recording holds, and where. Pure: times are epoch ms. */

export const DAY_MS = 86_400_000;

/** What the bar marks, with the bits of /archive/timeline. */
export const MARKS = [
  { bit: 64, id: "video", title: "pictures" },
  { bit: 2, id: "drive", title: "driven" },
  { bit: 32, id: "warning", title: "warnings" },
];
const PICTURE_BIT = 64;
const MOST_MARKS = 400; // of one kind: what is nearer to each other is one

/** @typedef {import("./archive.js").Timeline} Timeline @typedef {{since: number, until: number, why?: string}} Stretch */

/** @param {string} day "2026-11-22" @returns {number} its beginning; days are UTC */
export const startOf = (day) => Date.parse(`${day}T00:00:00Z`);

/** @param {number} ms @returns {string} */
export const dayOf = (ms) => new Date(ms).toISOString().slice(0, 10);

/** From the first to the last message of a day. @param {Timeline} timeline @param {string} day @returns {Stretch} */
export function extentOf({ from, step, activity }, day) {
  const first = activity.findIndex((bits) => bits !== 0);
  if (first < 0) return { since: startOf(day), until: startOf(day) + DAY_MS };
  return { since: from + first * step, until: from + step * (activity.findLastIndex((bits) => bits !== 0) + 1) };
}

/** When one thing happened. @param {Timeline} timeline @param {number} bit @param {Stretch} seen @returns {Stretch[]} */
export function stretchesOf({ from, step, activity }, bit, seen) {
  const apart = (seen.until - seen.since) / MOST_MARKS;
  /** @type {Stretch[]} */
  const stretches = [];
  activity.forEach((bits, index) => {
    const since = from + index * step;
    if (!(bits & bit) || since >= seen.until || since + step <= seen.since) return;
    const last = stretches.at(-1);
    if (last && since - last.until <= apart) last.until = since + step;
    else stretches.push({ since, until: since + step });
  });
  return stretches;
}

/** @param {Stretch[]} list @param {number} ms @returns {Stretch | undefined} the one that holds this time */
export const holding = (list, ms) => list.find(({ since, until }) => ms >= since && ms < until);

/**
 * What is exported: what was marked, else the session at that time, else a minute.
 * @param {number | null} marked in @param {number | null} end out @param {Stretch[]} sessions @param {number} ms
 */
export function stretchOf(marked, end, sessions, ms) {
  const session = holding(sessions, marked ?? end ?? ms);
  const since = marked ?? (session && (end === null || session.since < end) ? session.since : (end ?? ms + 60_000) - 60_000);
  const until = end ?? (session && session.until > since ? session.until : since + 60_000);
  return { since, until };
}

/**
 * Where a day begins to have pictures, first within its sessions; without any where its session begins, or the day.
 * @param {{timeline: Timeline | null, name: string}} day @param {boolean} [last] the last session comes first
 */
export function firstOf({ timeline, name }, last = false) {
  if (!timeline) return startOf(name);
  const sessions = last ? timeline.sessions.toReversed() : timeline.sessions;
  const all = [...sessions, extentOf(timeline, name)];
  for (const seen of all) {
    const shown = stretchesOf(timeline, PICTURE_BIT, seen);
    const first = shown.find(({ since, until }) => until - since > timeline.step) ?? shown[0]; // there are more after it
    if (first) return Math.min(first.since + timeline.step, seen.until);
  }
  return all[0].since;
}

/** What was said of a stretch without messages. @param {Stretch[]} gaps @param {Stretch} skipped */
export const whyOf = (gaps, { since, until }) => gaps.find((gap) => gap.since < until && gap.until > since)?.why ?? "";

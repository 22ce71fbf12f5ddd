/** Log lines of one component as the page keeps and filters them. Pure. */

export const MOST = 500;

/** From the least to the most important. */
export const LEVELS = ["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"];

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
   * @param {{origin: string, first: number, lines: readonly any[]}} message
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
      if (line.service) this.services.add(line.service);
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

/** @param {{message: string, t?: number, level?: string, service?: string}} record @param {number} number @returns {Line} */
function lineOf({ message, t = null, level = "", service = "" }, number) {
  return { number, t, level, rank: rankOf(level), service, text: message, gap: false };
}

/** @param {number} number @param {string} text @returns {Line} */
const gap = (number, text) => ({ number, t: null, level: "", rank: 0, service: "", text, gap: true });

const dropped = (count) => `… ${count} ${count === 1 ? "line was" : "lines were"} dropped`;

/** What is unknown counts as INFO: it must not be lost among details. */
const rankOf = (level) => (LEVELS.includes(level) ? LEVELS.indexOf(level) : 1);

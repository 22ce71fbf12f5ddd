/** What was sent to the robot while it was recorded, newest last. It is only shown. Pure. */

const MOST = 100;
const LONGEST = 200; // characters of a payload
const AGAIN_MS = 1000; // of the same metric within that time is one line

/**
 * ``count``: how many messages the line stands for, from ``since`` to ``at``
 * @typedef {{number: number, since: number, at: number, metric: string, text: string, count: number}} Line
 */

export class Incoming {
  constructor() {
    /** @type {Line[]} */
    this.lines = [];
    this.count = 0;
    /** @type {{at: number, x: number, z: number} | null} the newest command to drive */
    this.drive = null;
  }

  clear() {
    this.lines = [];
    this.drive = null;
  }

  /** @param {number} at @param {string} metric @param {unknown} value parsed; undefined: it is no JSON @param {number} bytes */
  take(at, metric, value, bytes) {
    if (metric === "drive-values") this.drive = { at, ...vectorOf(value) };
    const text = value === undefined ? `${bytes} bytes` : cut(JSON.stringify(value) ?? "");
    const last = this.lines.findLast((line) => line.metric === metric);
    if (last && at - last.at < AGAIN_MS && (metric === "drive-values" || value === undefined || last.text === text)) {
      Object.assign(last, { at, text, count: last.count + 1 });
      return;
    }
    this.lines.push({ number: ++this.count, since: at, at, metric, text, count: 1 });
    if (this.lines.length > MOST) this.lines.shift();
  }
}

/** @param {any} value @returns {{x: number, z: number}} each -1..1 */
function vectorOf(value) {
  const part = (one) => (Number.isFinite(one) ? Math.max(-1, Math.min(1, one)) : 0);
  return { x: part(value?.x), z: part(value?.z) };
}

const cut = (text) => (text.length > LONGEST ? `${text.slice(0, LONGEST)}…` : text);

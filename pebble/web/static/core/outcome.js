/**
 * What is seen of a robot after it was asked to restart, reboot or update: it acknowledges none of them. Pure; times are
 * epoch ms.
 */

import { isObject } from "./json.js";

const NOTHING_MS = 30_000; // without any change the robot has probably not done it
const WATCHED_MS = 15 * 60_000; // for so long a reboot may take
const UPDATE_MS = 120_000; // an update shows nothing here

/** @typedef {"reboot" | "service-restart" | "git-pull"} Action */
/**
 * @typedef {object} Seen
 * @property {boolean} connected whether the server is
 * @property {boolean | null} online whether the robot is; null: not known
 * @property {number | null} heartbeatAt its last one
 * @property {string} boots of its motor owners: others when they have started anew; "" unknown
 */

export class Outcome {
  /** @param {Action} action @param {number} askedAt @param {string} boots then */
  constructor(action, askedAt, boots = "") {
    this.action = action;
    this.askedAt = askedAt;
    this.boots = boots;
    this.refused = ""; // why it was not asked at all
    /** @type {number | null} */
    this.goneAt = null;
    /** @type {number | null} */
    this.backAt = null;
    /** @type {number | null} */
    this.startedAt = null;
    this.blindMs = 0; // without a connection to the server nothing was seen
    /** @type {number | null} */
    this.blindFrom = null;
  }

  /** @param {Seen} seen @param {number} now */
  see({ connected, online, heartbeatAt, boots }, now) {
    if (!connected) {
      this.blindFrom ??= now;
      return;
    }
    if (this.blindFrom !== null) this.blindMs += now - this.blindFrom;
    this.blindFrom = null;
    if (this.goneAt === null && online === false) this.goneAt = Math.max(this.askedAt, heartbeatAt ?? now);
    if (this.goneAt !== null && this.backAt === null && online === true) this.backAt = now;
    if (!this.boots) this.boots = boots;
    else if (boots && boots !== this.boots) this.startedAt ??= now;
  }

  /** @param {number} now @returns {boolean} whether there is nothing more to wait for */
  isOver(now) {
    if (this.refused || this.backAt !== null) return true;
    return now - this.askedAt > (this.action === "git-pull" ? UPDATE_MS : WATCHED_MS);
  }

  /**
   * @param {number} now @param {(ms: number) => string} clock 12:03:41 @returns {string[]} what was seen, in order, and
   * what that may mean
   */
  words(now, clock) {
    if (this.refused) return [`not asked: ${this.refused}`];
    const seen = /** @type {[string, number | null][]} */ ([
      ["asked", this.askedAt],
      ["heartbeat gone", this.goneAt],
      ["its programs have started anew", this.startedAt],
      ["back", this.backAt],
    ]);
    const steps = seen.filter(([, at]) => at !== null).map(([what, at]) => `${what} ${clock(Number(at))}`);
    const more = this.conclusion(now);
    return more ? [...steps, more] : steps;
  }

  /** @param {number} now */
  conclusion(now) {
    if (this.blindFrom !== null) return "not seen: there is no connection to the server";
    if (this.backAt !== null || this.startedAt !== null) return "";
    if (this.goneAt !== null) return `not back for ${seconds(now - this.goneAt)}`;
    if (this.action === "git-pull") return "heartbeats do not show an update: its log lines do";
    const waited = now - this.askedAt - this.blindMs;
    return waited < NOTHING_MS ? "waiting…" : `nothing changed for ${seconds(waited)}: the robot may not have done it`;
  }
}

const seconds = (ms) => (ms < 120_000 ? `${Math.floor(ms / 1000)} s` : `${Math.floor(ms / 60_000)} min`);

/** @param {unknown} owners of web/estop @returns {string} */
export function bootsOf(owners) {
  return Array.isArray(owners) ? owners.map((one) => `${one.owner} ${one.boot}`).sort().join(",") : "";
}

const SPELLINGS = {
  reboot: ["reboot"],
  "service-restart": ["service_restart", "service-restart"],
  "git-pull": ["git_pull", "git-pull"],
};

/**
 * Why a robot does not offer an action, by its capabilities in any of the original's spellings; "" it does. A robot
 * without capabilities is assumed to.
 * @param {Action} action @param {unknown} capabilities their value; undefined: unknown @returns {string}
 */
export function lacks(action, capabilities) {
  if (!isObject(capabilities)) return "";
  const system = isObject(capabilities.system) ? capabilities.system : {};
  const entry = SPELLINGS[action].map((name) => system[name] ?? capabilities[name]).find((one) => one !== undefined);
  if (entry === undefined) return "This robot does not offer it";
  if (entry === true) return "";
  if (!isObject(entry) || entry.available === false) return "This robot does not offer it";
  return entry.controls === false ? "Not set up on this robot" : "";
}

/** What an operator of many robots should learn without looking at each: found in their states, listed once. Pure. */

import { isObject } from "./json.js";

export const MOST = 50;
const ALOUD = 4; // sentences at once
const COMPONENTS = 600; // whose last states are remembered
const SERVICES = 64; // of one component
const LOW_PERCENT = 20;
const HYSTERESIS = 1.02; // times the limit: a battery above it is no longer low
const LONGEST = 160; // characters of what a robot reports of itself

/** @typedef {"offline" | "online" | "stop" | "battery" | "script" | "service" | "undriveable" | "driveable" | "asks"} Kind */
/**
 * One line of the list: what happens again and again is one line with a count. Times are epoch ms.
 * @typedef {{key: string, ref: string, kind: Kind, text: string, at: number, since: number, count: number,
 *   unread: boolean, number: number}} Notice  ``number`` grows with each that is added
 */

/** The list, the newest first. */
export class Notices {
  constructor() {
    /** @type {Notice[]} */
    this.list = [];
    this.number = this.announced = 0; // of the newest, and of the newest that was read aloud
  }

  /** @param {{key?: string, ref: string, kind: Kind, text: string, at: number}} notice */
  add({ key = "", ref, kind, text, at }) {
    const whole = `${key || kind}\n${ref}`;
    const old = this.list.find((one) => one.key === whole);
    const { since, count } = old ?? { since: at, count: 0 };
    const rest = this.list.filter((one) => one !== old);
    this.list = [{ key: whole, ref, kind, text, at, since, count: count + 1, unread: true, number: ++this.number }, ...rest].slice(0, MOST);
  }

  get unread() {
    return this.list.filter((one) => one.unread).length;
  }

  read() {
    this.list = this.list.map((one) => (one.unread ? { ...one, unread: false } : one));
  }

  clear() {
    this.list = [];
  }
}

/**
 * What is read aloud of ``notices``, the newest first: stops, then the others as they came.
 * @param {Notice[]} notices @param {(ref: string) => string} name
 */
export function aloud(notices, name) {
  const rank = (/** @type {Notice} */ one) => (one.kind === "stop" ? 0 : 1);
  const sentences = [...notices]
    .reverse()
    .sort((one, other) => rank(one) - rank(other))
    .map((one) => `${name(one.ref)} ${one.text}`);
  const more = sentences.length - ALOUD;
  return [...sentences.slice(0, ALOUD), ...(more > 0 ? [`and ${more} more`] : [])].join(". ");
}

/** The last state of one component. @typedef {{online?: boolean, latched?: boolean, failure?: string, low?: boolean,
 *  asks?: string, driveable?: string, undriveable?: boolean, services?: Map<string, {failed: boolean, restarts: number}>}} Known */

/** Compares the states of components with those before. The first state of each is only remembered. */
export class Watcher {
  /** @param {Notices} notices */
  constructor(notices) {
    this.notices = notices;
    /** @type {Map<string, Known>} */
    this.components = new Map();
  }

  /** @param {string} ref @param {boolean | null | undefined} online null: not known @param {number} at */
  online(ref, online, at) {
    if (typeof online !== "boolean") return;
    const known = this.known(ref);
    const before = known.online;
    known.online = online;
    if (before === undefined || before === online) return;
    const [kind, text] = online ? /** @type {const} */ (["online", "is online again"]) : ["offline", "is offline"];
    this.notices.add({ key: "presence", ref, kind: /** @type {Kind} */ (kind), text, at });
  }

  /** @param {string} ref @param {unknown} view of web/estop @param {number} at */
  stop(ref, view, at) {
    if (!isObject(view)) return;
    const known = this.known(ref);
    const latched = view.latched === true;
    if (latched && known.latched === false) {
      this.notices.add({ ref, kind: "stop", text: `was stopped by ${short(view.by) || "an unknown sender"}`, at });
    }
    known.latched = latched;
  }

  /**
   * That it can no longer be driven, while a person or a script drives it; and then that it can again.
   * @param {string} ref @param {unknown} value of its status @param {boolean} driven @param {number} at
   */
  driveable(ref, value, driven, at) {
    const { state, why } = isObject(value) ? value : {};
    if (state !== "yes" && state !== "no") return; // not known
    const known = this.known(ref);
    const lost = state === "no" && known.driveable === "yes" && driven;
    known.driveable = state;
    if (lost) this.notices.add({ key: "driveable", ref, kind: "undriveable", text: `cannot be driven${why ? `: ${short(why)}` : ""}`, at });
    else if (state === "yes" && known.undriveable) this.notices.add({ key: "driveable", ref, kind: "driveable", text: "can be driven again", at });
    else return;
    known.undriveable = lost;
  }

  /** Who asks this page for control. @param {string} ref @param {unknown} view of web/driver @param {number} at */
  asked(ref, view, at) {
    const asks = isObject(view) && view.you === true ? short(view.asks) : "";
    const known = this.known(ref);
    if (asks && asks !== known.asks) this.notices.add({ ref, kind: "asks", text: `is wanted: ${asks} asks to drive`, at });
    known.asks = asks;
  }

  /** @param {string} ref @param {unknown} status of autonomy @param {number} at */
  script(ref, status, at) {
    if (!isObject(status)) return;
    const known = this.known(ref);
    const failure = status.error ? `script ${short(status.file) || "?"} failed: ${short(status.error)}` : "";
    if (failure && known.failure !== undefined && known.failure !== failure) {
      this.notices.add({ ref, kind: "script", text: failure, at });
    }
    known.failure = failure;
  }

  /** @param {string} ref @param {unknown} services of its status, by name @param {number} at */
  services(ref, services, at) {
    if (!isObject(services)) return;
    const known = this.known(ref);
    const before = known.services;
    known.services = new Map();
    for (const [name, one] of Object.entries(services).slice(0, SERVICES)) {
      if (!isObject(one)) continue;
      const now = { failed: one.state === "failed", restarts: Number.isFinite(one.restarts) ? one.restarts : 0 };
      known.services.set(name, now);
      const old = before?.get(name);
      if (!old || !((now.failed && !old.failed) || now.restarts > old.restarts)) continue;
      const what = now.failed ? "fails again and again" : "has ended, and is started again";
      const how = one.last_exit ? ` (${short(one.last_exit)})` : "";
      this.notices.add({ key: `service ${name}`, ref, kind: "service", text: `service ${short(name)} ${what}${how}`, at });
    }
  }

  /**
   * A voltage says nothing about a battery that is not known: only below a limit that the user has set. Per cent below
   * 20 are low.
   * @param {string} ref @param {{value: unknown, unit: string, charging: boolean, limit: number | null}} level
   * @param {number} at
   */
  battery(ref, { value, unit, charging, limit }, at) {
    if (typeof value !== "number" || !Number.isFinite(value)) return;
    const least = limit ?? (unit === "%" ? LOW_PERCENT : null);
    const known = this.known(ref);
    if (least === null || charging || value >= least * HYSTERESIS) known.low = false;
    else if (value < least && !known.low) {
      known.low = true;
      const shown = `${Number(value.toFixed(2))}${unit ? ` ${short(unit)}` : ""}`;
      this.notices.add({ ref, kind: "battery", text: `has a low battery: ${shown}, below ${least}`, at });
    }
  }

  /** @param {string} ref @returns {Known} */
  known(ref) {
    let known = this.components.get(ref);
    if (!known) {
      if (this.components.size >= COMPONENTS) this.components.delete(this.components.keys().next().value ?? "");
      this.components.set(ref, (known = {}));
    }
    return known;
  }
}

/** Text of a robot, which may be any JSON. */
const short = (value) => {
  const text = typeof value === "object" && value !== null ? JSON.stringify(value) : String(value ?? "");
  return text.length > LONGEST ? `${text.slice(0, LONGEST)}…` : text;
};

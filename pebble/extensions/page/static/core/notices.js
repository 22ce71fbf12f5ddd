/** What an operator of many robots should learn without looking at each: the newest event of each. Pure. */

import { isObject } from "./json.js";

export const MOST = 50; // in the list
const ALOUD = 4; // sentences at once
const LOW_PERCENT = 20;
const MARGIN = 5; // per cent, more than one step of what measures a battery: within it a reading counts for nothing
const READINGS = 2; // below, of which the last one is told
const CHARGED_PERCENT = 50; // also where nothing tells that it is charged
const LONGEST = 160; // characters of what a robot reports of itself

/** @typedef {{ref: string, kind: string, text: string, at: number, unread: boolean}} Notice  ``at`` is epoch ms */
/** @typedef {{state: any, kind?: string, text?: string}} Event  ``text`` "": nothing to tell */

/**
 * What a state tells, given the one before; null: it is not known. The first one of each component is only remembered.
 * @type {Record<string, (before: any, ...given: any[]) => Event | null>}
 */
const EVENTS = {
  presence(_before, online) {
    if (typeof online !== "boolean") return null;
    return online ? { state: true, kind: "online", text: "is online again" } : { state: false, kind: "offline", text: "is offline" };
  },
  stop(_before, view) {
    if (!view) return null;
    const state = view.latched === true;
    return { state, text: state ? `was stopped by ${short(view.by) || "an unknown sender"}` : "" };
  },
  /** Who asks this page for control. */
  asks(_before, view) {
    const state = view?.you ? short(view.asks) : "";
    return { state, text: state && `is wanted: ${state} asks to drive` };
  },
  script(_before, status) {
    if (!status) return null;
    const state = status.error && !status.stopped ? `script failed: ${short(status.error)}` : "";
    return { state, text: state };
  },
  /** That it can no longer be driven, while a person or a script drives it; and then that it can again. */
  driveable(before, value, driven) {
    const { state, why } = isObject(value) ? value : {};
    if (state === "yes") return { state, kind: "driveable", text: before === "lost" ? "can be driven again" : "" };
    if (state !== "no") return null;
    const lost = before === "lost" || (before === "yes" && driven);
    return { state: lost ? "lost" : "no", kind: "undriveable", text: lost ? `cannot be driven${why ? `: ${short(why)}` : ""}` : "" };
  },
  service(before, services) {
    if (!isObject(services)) return null;
    const all = Object.entries(services).filter(([, service]) => isObject(service));
    const rank = ({ state, restarts }) => (state === "failed" ? Infinity : Number(restarts) || 0);
    const state = Object.fromEntries(all.map(([name, service]) => [name, rank(service)]));
    const [name, service] = all.find(([name]) => state[name] > before?.[name]) ?? [""];
    if (!service) return { state };
    const what = service.state === "failed" ? "fails again and again" : "has ended, and is started again";
    return { state, text: `service ${short(name)} ${what}${service.last_exit ? ` (${short(service.last_exit)})` : ""}` };
  },
  /** Of a battery that is not charged: once, and again only after it was. The state is how many readings were below. */
  battery(before = 0, percent, charging) {
    if (percent === null) return null;
    if (charging && before >= READINGS && before < 3 * READINGS) return { state: before + 1 }; // its contact may flap
    if (charging || percent >= (before < READINGS ? LOW_PERCENT + MARGIN : CHARGED_PERCENT)) return { state: 0 };
    const state = Math.min(READINGS, before + Number(percent < LOW_PERCENT));
    return { state, text: before < READINGS && state === READINGS ? `has a low battery: ${Math.round(percent)} %` : "" };
  },
};

export class Notices {
  constructor() {
    /** @type {Notice[]} the newest of each component, the newest first */
    this.list = [];
    /** @type {Notice[]} all that were not read aloud yet */
    this.fresh = [];
    /** @type {Map<string, Map<string, any>>} by component and event */
    this.states = new Map();
  }

  /** @param {string} ref @param {keyof EVENTS} event @param {number} at epoch ms @param {...any} given what EVENTS reads */
  see(ref, event, at, ...given) {
    const states = this.states.get(ref) ?? new Map();
    this.states.set(ref, states);
    const before = states.get(event);
    const seen = EVENTS[event](before, ...given);
    if (!seen) return;
    const { state, kind = event, text } = seen;
    states.set(event, state);
    if (before === undefined || before === state || !text) return;
    const notice = { ref, kind, text, at, unread: true };
    this.list = [notice, ...this.list.filter((old) => old.ref !== ref)].slice(0, MOST);
    this.fresh = [...this.fresh, notice].slice(-MOST);
  }

  get unread() {
    return this.list.filter((notice) => notice.unread).length;
  }

  read() {
    this.list = this.list.map((notice) => ({ ...notice, unread: false }));
    this.fresh = [];
  }
}

/** @param {Notice[]} notices @param {(ref: string) => string} name @returns {string} what is read aloud of them, stops first */
export function aloud(notices, name) {
  const isStop = ({ kind }) => kind === "stop";
  const sentences = [...notices.filter(isStop), ...notices.filter((notice) => !isStop(notice))].map(({ ref, text }) => `${name(ref)} ${text}`);
  const more = sentences.length - ALOUD;
  return [...sentences.slice(0, ALOUD), ...(more > 0 ? [`and ${more} more`] : [])].join(". ");
}

/** Text of a robot, which may be any JSON. */
const short = (value) => {
  const text = typeof value === "object" && value !== null ? JSON.stringify(value) : String(value ?? "");
  return text.length > LONGEST ? `${text.slice(0, LONGEST)}…` : text;
};

/** Which of the gamepads drives, what every one of them stops, and why one is ignored. Pure. */

import { PAD_ESTOP, padVector } from "./inputs.js";

const GONE_MS = 2000; // a gamepad that was away for less is the same one
const LEFT = 0.1; // how far a stick has left neutral on purpose: a worn one is less far
const PUSHED = 0.5; // takes over from one that drives
const ECHO_MS = 150; // two that do the same within it are one device, listed twice
const WORN_MS = 2000; // people do not hold STOP for so long

/** @typedef {import("./inputs.js").Pad} Pad */
/** @typedef {(id: string) => import("./inputs.js").Mapping} MappingOf */
/** @typedef {"axes"|"stop-held"|"focus"|"off-centre"|"release"|"held"|"copy"|"other"} PadCode */

/** What is known of one gamepad. */
class Known {
  constructor(pad) {
    /** @type {Pad | null} null: it has vanished */
    this.pad = pad;
    this.goneAt = Infinity; // since when it is not listed
    this.neutral = false; // its stick was seen there since it appeared, or since this window has the focus
    this.far = 0; // how far its stick is; NaN: it has none that can be read
    this.stopped = this.latched = false;
    this.latchedAt = 0;
    /** @type {Set<number>} buttons that are pressed */
    this.pressed = new Set();
    /** @type {Set<number>} of these, those that were when it appeared */
    this.old = pressed(pad);
    /** @type {Map<string, number>} when something was last done on purpose */
    this.acts = new Map();
    this.copy = false; // it does what the one that drives does
  }
}

export class PadChoice {
  constructor() {
    /** @type {Map<string, Known>} by index and id */
    this.known = new Map();
    this.key = ""; // of the one that drives
    /** @type {{key: string, act: string, at: number} | null} what may take over from one that drives */
    this.asks = null;
  }

  /** @returns {[string, Known][]} those that there are */
  get here() {
    return [...this.known].filter(([, { pad }]) => pad);
  }

  /** The one that drives, or would. @returns {Pad | null} */
  get pad() {
    return this.known.get(this.key)?.pad ?? null;
  }

  /**
   * Take what the browser shows now.
   * @param {readonly Pad[]} list @param {number} now milliseconds
   * @returns {boolean} whether an emergency stop was pressed on any of them. One that is held when a gamepad appears
   *   counts once: browsers show a gamepad only after a button was pressed, and this may be it.
   */
  see(list, now) {
    let stop = false;
    for (const one of this.known.values()) one.pad = null;
    list.forEach((pad, place) => {
      const usual = `${pad.index} ${pad.id}`;
      const key = this.known.get(usual)?.pad ? `${place}. ${usual}` : usual; // no two share one
      const one = this.known.get(key) ?? new Known(pad);
      const latched = PAD_ESTOP.every((button) => pad.buttons[button]?.pressed);
      if (latched && !one.latched) {
        stop = true;
        one.latchedAt = now;
      }
      this.known.set(key, Object.assign(one, { pad, goneAt: Infinity, latched }));
    });
    for (const [key, one] of this.known) {
      if (one.pad) continue;
      Object.assign(one, { neutral: false, goneAt: Math.min(one.goneAt, now) });
      if (now - one.goneAt > GONE_MS) this.known.delete(key);
    }
    return stop;
  }

  /**
   * Find the one that drives; to be called after ``see``.
   * @param {number} now @param {MappingOf} mappingOf @param {boolean} focused
   * @param {boolean} drives whether the one that drives moves anything
   * @returns {{stop: boolean, changed: boolean, act: string}} ``stop``: the button for it was pressed on any of them.
   *   ``changed``: another one drives now, by this act of it: "" it was not touched
   */
  choose(now, mappingOf, focused, drives) {
    const answer = { stop: false, changed: false, act: "" };
    /** @type {{key: string, act: string, at: number}[]} */
    const asking = [];
    for (const [key, one] of this.here) {
      const mapping = mappingOf(one.pad.id);
      const stopped = one.latched || one.pad.buttons[mapping.buttons.stop]?.pressed === true;
      answer.stop ||= stopped && !one.stopped && !one.latched;
      one.stopped = stopped;
      for (const act of look(one, mapping, focused)) {
        one.acts.set(act, now);
        if (key !== this.key && one.neutral) asking.push({ key, act, at: now });
      }
    }
    const before = this.pad && this.known.get(this.key);
    const taker = drives ? this.due(asking, now) : asking.find((one) => one.act !== "pushed" && !same(one, before));
    if (!drives) this.asks = null;
    const key = taker?.key ?? (before ? this.key : this.first());
    if (key !== this.key) this.pick(key);
    else return answer;
    return { ...answer, changed: true, act: taker?.act ?? "" };
  }

  /** @param {string} key */
  pick(key) {
    this.key = key;
    this.asks = null;
    for (const one of this.known.values()) one.copy = false;
  }

  /** What takes over from one that drives: a push or a button, unless that one did the same a moment before or after. */
  due(asking, now) {
    this.asks ??= asking.find(({ act }) => act !== "left") ?? null;
    const { asks } = this;
    if (!asks || now - asks.at < ECHO_MS) return undefined;
    this.asks = null;
    const one = this.known.get(asks.key);
    if (!one?.neutral) return undefined; // it has vanished
    one.copy = same(asks, this.known.get(this.key));
    return one.copy ? undefined : asks;
  }

  /** Where none was touched yet. */
  first() {
    const usable = this.here.filter(([, { neutral }]) => neutral);
    return (usable.find(([, { pad }]) => /attack 3/i.test(pad.id)) ?? usable[0] ?? this.here[0] ?? [""])[0];
  }

  /**
   * Why gamepads are ignored, wholly or in part.
   * @param {number} now @param {boolean} focused
   * @param {boolean} armed whether the one that drives was seen in neutral since it was interrupted
   * @returns {{pad: Pad, key: string, code: PadCode, buttons: number[]}[]}
   */
  ignored(now, focused, armed) {
    return this.here.flatMap(([key, one]) => {
      const isOff = key === this.key ? !armed : !one.neutral;
      const code = why(one, now, focused, isOff, key !== this.key);
      return code ? { pad: one.pad, key, code, buttons: [...one.old] } : [];
    });
  }
}

/** @param {Known} one @returns {PadCode | ""} */
function why(one, now, focused, isOff, other) {
  if (Number.isNaN(one.far)) return "axes";
  if (one.latched && now - one.latchedAt > WORN_MS) return "stop-held";
  if (!focused) return one.far || one.pressed.size ? "focus" : "";
  if (one.far && isOff) return one.neutral ? "release" : "off-centre";
  if (one.old.size) return "held";
  if (one.copy) return "copy";
  return other && one.far > LEFT ? "other" : "";
}

/** What was done on purpose since it was last looked at. @param {Known} one @returns {string[]} */
function look(one, mapping, focused) {
  const now = pressed(one.pad);
  for (const index of one.old) if (!now.has(index)) one.old.delete(index);
  const acts = [...now].filter((index) => !one.pressed.has(index) && !one.old.has(index)).map((index) => `button ${index}`);
  const vector = padVector(one.pad, mapping);
  const far = vector ? Math.max(...Object.values(vector).map(Math.abs)) : NaN;
  if (far > LEFT && one.far <= LEFT) acts.push("left");
  if (far > PUSHED && one.far <= PUSHED) acts.push("pushed");
  one.neutral = focused && vector !== null && (one.neutral || far === 0);
  Object.assign(one, { pressed: now, far });
  return acts;
}

/** @param {{act: string, at: number}} asked @param {Known | null | undefined} other @returns {boolean} whether it has just done this, too */
const same = ({ act, at }, other) => Math.abs(at - (other?.acts.get(act) ?? -Infinity)) < ECHO_MS;

const pressed = ({ buttons }) => new Set(buttons.flatMap((one, index) => (one.pressed ? index : [])));

// The lights of each component, as this browser asked for them last: no robot reports its lights.

import { Model, read, write } from "../parts/models.js";
import { sectionOf, whyNot, whyNotEnd } from "../parts/why-not.js";
import { nameIn } from "../parts/looks.js";

export const SHORTEST_S = 0.05;
export const LONGEST_S = 10;
const STEP_MS = 200;
const COLOUR = /^#[0-9a-f]{6}$/;
const FIRST = { colour: "#ff8800", period: 2, mode: "", steady: "off" };

/** @typedef {"solid" | "flash" | "off"} Mode */

/** What was asked of one component's lights. ``mode`` "": nothing yet. */
export class Lights extends Model {
  /** @param {string} ref */
  constructor(ref) {
    super();
    this.ref = ref;
    const stored = read(`lights ${ref}`, FIRST);
    this.colour = COLOUR.test(stored.colour) ? stored.colour : FIRST.colour;
    this.period = period(stored.period);
    /** @type {Mode | ""} */
    this.mode = ["solid", "flash", "off"].includes(stored.mode) ? stored.mode : "";
    /** @type {Mode} what a flash returns to */
    this.steady = stored.steady === "solid" ? "solid" : "off";
    this.sentAt = -Infinity;
    this.timer = 0; // of what was asked too soon after that
    this.passed = this.state; // what the server has passed on last
    this.n = 0; // of the newest command
  }

  get state() {
    const { colour, mode, steady } = this;
    return { colour, period: this.period, mode, steady };
  }

  /**
   * Ask for this; in quick succession at most five times a second, and always for the newest.
   * @param {any} page its services @param {{colour?: string, period?: number, mode?: Mode}} change
   */
  ask(page, { colour = this.colour, period: seconds = this.period, mode }) {
    if (COLOUR.test(colour)) this.colour = colour;
    this.period = period(seconds);
    this.mode = mode ?? (this.mode === "flash" ? "flash" : "solid");
    if (this.mode !== "flash") this.steady = this.mode;
    this.soon(page);
    this.changed();
  }

  soon(page) {
    const send = () => {
      this.timer = 0;
      this.sentAt = performance.now();
      this.send(page);
    };
    const wait = this.sentAt + STEP_MS - performance.now();
    if (wait > 0) this.timer ||= setTimeout(send, wait);
    else if (!this.timer) send();
  }

  /** What is refused was not asked: it is as it was before. */
  send({ store, commands, connection }) {
    const { solid } = supported(store.get(this.ref, "capabilities")?.value);
    const { state } = this;
    const n = (this.n = commands.setLights(this.ref, command(this, solid)));
    if (!n) return this.restore();
    const end = connection.onChange(() => {
      const answer = connection.answers.get(n);
      if (answer?.op === "done") {
        // Of what does not flash, the period is only the next flash's: it may have changed since.
        this.passed = state.mode === "flash" ? state : { ...state, period: this.passed.period };
        this.save();
      } else if ((answer || !connection.isOpen) && n === this.n && !this.timer) {
        this.restore();
      }
      if (answer || !connection.isOpen) end();
    });
  }

  restore() {
    Object.assign(this, this.passed);
    this.changed();
  }

  /** For the next flash. @param {number} seconds */
  setPeriod(seconds) {
    this.period = this.passed.period = period(seconds);
    this.save();
    this.changed();
  }

  save() {
    write(`lights ${this.ref}`, this.passed);
  }
}

/**
 * What to send. Lights that can only flash are off when they flash in black.
 * @param {Pick<Lights, "colour" | "period" | "mode">} lights @param {boolean} solid whether they can be that
 */
export function command({ colour, period: seconds, mode }, solid) {
  const share = (at) => Math.round((1000 * parseInt(colour.slice(at, at + 2), 16)) / 255) / 1000;
  const rgb = mode === "off" ? { r: 0, g: 0, b: 0 } : { r: share(1), g: share(3), b: share(5) };
  return mode === "flash" || !solid ? { ...rgb, period: seconds } : rgb;
}

const period = (value) => (Number.isFinite(value) ? Math.min(LONGEST_S, Math.max(SHORTEST_S, value)) : FIRST.period);

/** @param {unknown} capabilities payload @returns {{solid: boolean, flash: boolean}} what its lights can do */
export function supported(capabilities) {
  const lights = sectionOf(capabilities, "lights");
  const has = (name) => lights[name] === true || (lights[name] === undefined && lights.available === true);
  return { solid: has("solid"), flash: has("flash") };
}

const all = new Map();

/** @param {string} ref @returns {Lights} */
export function lightsOf(ref) {
  if (!all.has(ref)) all.set(ref, new Lights(ref));
  return all.get(ref);
}

/** @param {any} page its services @param {string} ref @param {"solid" | "flash"} kind @returns {string} "" they can */
export function whyNotLights(page, ref, kind) {
  const why = whyNot(page, ref, "lights");
  if (why || supported(page.store.get(ref, "capabilities")?.value)[kind]) return why;
  return `${nameIn(page.store, ref)} has no lights that ${kind === "flash" ? "flash" : "stay on"}`;
}

/**
 * Flash, or end that: then they are as they were before. For the key F.
 * @param {any} page its services @param {string} ref @returns {string} why not; "" it was asked
 */
export function toggleFlash(page, ref) {
  const lights = lightsOf(ref);
  const mode = lights.mode === "flash" ? lights.steady : "flash";
  const why = mode === "off" ? whyNotEnd(page) : whyNotLights(page, ref, "flash");
  if (!why) lights.ask(page, { mode });
  return why;
}

/** Learns which axis and button of a gamepad does what, from what is moved when the page asks for it. Pure. */

import { ACTIONS, PAD_ACTIONS } from "./actions.js";
import { PAD_ESTOP } from "./inputs.js";
import { MOST } from "./pad-mapping.js";

const MOVED = 0.6; // an axis that was pushed on purpose
const STILL = 0.25; // one that was let go
const [LEAST_ZONE, MOST_ZONE] = [0.1, 0.35];
const MARGIN = 0.05; // of the dead zone, beyond where an axis rests
const OFF_CENTRE = MOST_ZONE - MARGIN; // of an axis at rest: it is a lever, or a trigger
const NOISE = 0.05; // of an axis that stays where it is
const SETTLED_MS = 500;

/** @typedef {{id: string, kind: "axis" | "button", ask: string}} Step */

/** @type {readonly Step[]} in the order in which they are asked for */
export const STEPS = [
  { id: "z", kind: "axis", ask: "Push the stick forward, and hold it" },
  { id: "x", kind: "axis", ask: "Push the stick to the right, and hold it" },
  ...PAD_ACTIONS.map(({ id, words }) => ({ id, kind: /** @type {"button"} */ ("button"), ask: `Press the button for: ${words}` })),
];

/** @typedef {{axes: readonly number[], buttons: readonly {pressed: boolean}[]}} Sample */

export class Learning {
  /** @param {Sample} sample while nothing is touched */
  constructor(sample) {
    this.rest = sample;
    this.at = 0;
    this.released = true; // what was moved for the step before
    /** @type {readonly number[]} the axes when they last changed, while something has to be released */
    this.seen = [];
    this.seenAt = 0;
    this.problem = "";
    /** @type {Record<string, import("./inputs.js").Axis>} */
    this.axes = {};
    /** @type {Record<string, number>} */
    this.buttons = {};
  }

  /** @returns {Step | undefined} undefined: all is known */
  get step() {
    return STEPS[this.at];
  }

  /** @param {Sample} sample what the gamepad shows now @param {number} now milliseconds */
  take(sample, now) {
    const isAxis = this.step?.kind === "axis";
    const moved = isAxis ? this.movedAxis(sample, this.released ? MOVED : STILL) : this.pressedButton(sample);
    if (!this.released) {
      this.released = moved < 0;
      this.settle(sample.axes, now);
    } else if (moved >= 0) {
      if (isAxis) this.takeAxis(moved, sample);
      else if (this.step) this.takeButton(moved);
    }
  }

  /** Without a button for this step. Axes cannot be left out. */
  skip() {
    if (this.step?.kind !== "button") return;
    this.buttons[this.step.id] = -1;
    this.next();
  }

  /** @returns {import("./inputs.js").Mapping} what was learned */
  mapping() {
    const noise = Math.max(...Object.values(this.axes).map(({ axis }) => Math.abs(this.rest.axes[axis])));
    const deadZone = Math.round(100 * Math.min(MOST_ZONE, Math.max(LEAST_ZONE, noise + MARGIN))) / 100;
    return { x: this.axes.x, z: this.axes.z, deadZone, buttons: this.buttons };
  }

  next() {
    this.problem = "";
    this.at += 1;
    this.wait();
  }

  refuse(why) {
    this.problem = why;
    this.wait();
  }

  /** Until it is released. */
  wait() {
    this.released = false;
    this.seen = [];
  }

  /** An axis that stays where it is, as a lever does, rests there; those that were learned rest where they did. */
  settle(axes, now) {
    if (!axes.every((value, index) => Math.abs(value - this.seen[index]) < NOISE)) {
      this.seen = [...axes];
      this.seenAt = now;
    } else if (now - this.seenAt > SETTLED_MS) {
      const known = Object.values(this.axes).map(({ axis }) => axis);
      this.rest = { ...this.rest, axes: axes.map((value, index) => (known.includes(index) ? this.rest.axes[index] : value)) };
    }
  }

  pressedButton({ buttons }) {
    return buttons.slice(0, MOST).findIndex((one, index) => one.pressed && !this.rest.buttons[index]?.pressed);
  }

  movedAxis({ axes }, limit) {
    const moved = axes.slice(0, MOST).map((value, index) => Math.abs(value - (this.rest.axes[index] ?? 0)));
    const most = Math.max(0, ...moved);
    return most > limit ? moved.indexOf(most) : -1;
  }

  takeAxis(axis, sample) {
    const rest = this.rest.axes[axis] ?? 0;
    if (Math.abs(rest) > OFF_CENTRE) return this.refuse("This axis does not rest in the middle: use another one");
    if (Object.values(this.axes).some((one) => one.axis === axis)) {
      return this.refuse("That is the axis that you pushed before: push the other way");
    }
    this.axes[this.step.id] = { axis, invert: sample.axes[axis] < rest };
    this.next();
  }

  takeButton(button) {
    if (PAD_ESTOP.includes(button)) {
      return this.refuse(`${PAD_ESTOP.map((one) => `Button ${one + 1}`).join(" and ")} together are STOP: use another`);
    }
    const taken = Object.keys(this.buttons).find((id) => this.buttons[id] === button);
    if (taken) return this.refuse(`That button is taken: ${ACTIONS.find(({ id }) => id === taken)?.words}`);
    this.buttons[this.step.id] = button;
    this.next();
  }
}

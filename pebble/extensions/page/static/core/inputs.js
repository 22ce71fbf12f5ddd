/** What keys, stick, buttons and gamepad ask for, as one vector. Pure: events are passed in by driver.js. */

import { attempt } from "./browser.js";

export const LEFT = ["KeyA", "ArrowLeft"];
export const RIGHT = ["KeyD", "ArrowRight"];
export const FORWARD = ["KeyW", "ArrowUp"];
export const BACK = ["KeyS", "ArrowDown"];
export const UP = ["KeyQ"];
export const DOWN = ["KeyE"];
export const DRIVE_KEYS = new Set([...LEFT, ...RIGHT, ...FORWARD, ...BACK, ...UP, ...DOWN]);

const DEAD_ZONE = 0.1; // of the stick on the page
const PAD_DEAD_ZONE = 0.15; // worn sticks rest so far from the middle
const FROZEN_MS = 3000; // a deflected gamepad that drives, and whose time stands still, may be gone
export const PAD_ESTOP = [8, 9]; // buttons that no mapping has

/** @typedef {{speed: number, turn: number, balance: number}} Sliders speed and turn 0..1, balance -1..1 */
/**
 * @typedef {{id: string, index: number, mapping: string, axes: readonly number[],
 *   buttons: readonly {pressed: boolean}[], timestamp: number}} Pad
 */
/** @typedef {{axis: number, invert: boolean}} Axis */
/**
 * What of a gamepad does what. ``auxiliary``, while held: the horizontal axis is the auxiliary one. Buttons of other
 * actions are where actions.js says unless they are here, too; -1 is none.
 * @typedef {{x: Axis, z: Axis, buttons: Record<string, number>}} Mapping
 */

/** @type {Mapping} of the standard layout */
export const USUAL = {
  x: { axis: 0, invert: false },
  z: { axis: 1, invert: true },
  buttons: { stop: 0, auxiliary: 1 },
};

/** Mappings of gamepads without the standard layout, by what their id has. @type {(Mapping & {id: RegExp})[]} */
export const MAPPINGS = [
  { id: /attack 3/i, ...USUAL },
  { id: /046d-c216|dual action/i, ...USUAL, buttons: { stop: 1, auxiliary: 2 } }, // Logitech F310 at D: its buttons begin with X
];

/** @param {{id: string, mapping: string}} pad @returns {Mapping} */
export const mappingOf = ({ id, mapping }) => (mapping !== "standard" && MAPPINGS.find((known) => known.id.test(id))) || USUAL;

/** What people call it: browsers add its numbers. @param {{id: string}} pad */
export const padName = ({ id }) => String(id).split(" (")[0].replace(/^([0-9a-f]{4}-){2}/i, "").replace(/^(\w+) (?=\1 )/, "").slice(0, 24).trim() || "Gamepad";

/** Presses of the buttons that stop, on every gamepad. */
export class PadStops {
  /** @type {Set<string>} what is pressed, by gamepad */
  pressed = new Set();

  /**
   * Take what the browser shows. A button that is pressed when a gamepad appears counts: browsers show a gamepad only
   * after a button was pressed, and this may be it.
   * @param {readonly any[]} shown with holes @returns {"" | "stop" | "latch"} what was pressed since the last time
   */
  read(shown) {
    const before = this.pressed;
    this.pressed = new Set(shown.flatMap((pad, place) => stopsOf(pad).map((kind) => `${kind} ${place} ${attempt(() => pad.id, "")}`)));
    const isNew = (kind) => [...this.pressed].some((press) => press.startsWith(kind) && !before.has(press));
    return isNew("latch") ? "latch" : isNew("stop") ? "stop" : "";
  }
}

/** @returns {("stop" | "latch")[]} */
function stopsOf(pad) {
  const isPressed = (index) => attempt(() => pad.buttons[index].pressed === true, false);
  const stops = isPressed(attempt(() => mappingOf(pad).buttons.stop, USUAL.buttons.stop));
  return [...(PAD_ESTOP.every(isPressed) ? /** @type {const} */ (["latch"]) : []), ...(stops ? /** @type {const} */ (["stop"]) : [])];
}

export class Inputs {
  constructor() {
    /** @type {Set<string>} */
    this.keys = new Set();
    /** @type {Set<string>} keys, and "stick", that are held, but count only after they were released */
    this.waiting = new Set();
    /** @type {Map<string, number>} value of each button that is held on the page, by name */
    this.held = new Map();
    this.stick = { x: 0, z: 0 };
    /** @type {number|null} */
    this.pointer = null; // that moves the stick
    this.pad = { x: 0, z: 0, y: 0 };
    this.padArmed = false; // it was seen in neutral since it appeared
    this.padFrozen = false;
    this.padStamp = "";
    this.padMovedAt = 0;
  }

  /** @param {string} code @param {boolean} repeat @returns {boolean} whether the key drives */
  keyDown(code, repeat) {
    if (!DRIVE_KEYS.has(code)) return false;
    if (!repeat) {
      this.waiting.delete(code);
      this.keys.add(code);
    } else if (!this.keys.has(code)) this.waiting.add(code); // it was held before, perhaps in another window
    return true;
  }

  /** @param {string} code @returns {boolean} whether the key was held */
  keyUp(code) {
    const known = this.waiting.delete(code) || this.keys.has(code);
    this.keys.delete(code);
    if (!this.keys.size) this.waiting.clear(); // the release of the others may have been lost
    return known;
  }

  /** @param {number} pointer @returns {boolean} whether the stick is free for it */
  stickStart(pointer) {
    if (this.pointer !== null) return false;
    this.pointer = pointer;
    return true;
  }

  /** @param {number} x @param {number} z each -1..1 */
  stickMove(x, z) {
    const length = Math.hypot(x, z);
    const scale = length > 1 ? 1 / length : 1;
    this.stick = { x: zone(x * scale), z: zone(z * scale) };
  }

  stickEnd() {
    this.waiting.delete("stick");
    this.pointer = null;
    this.stick = { x: 0, z: 0 };
  }

  /** A button of the page that moves an axis while it is held. @param {string} name @param {number} value 0: released */
  hold(name, value) {
    if (value) this.held.set(name, value);
    else this.held.delete(name);
  }

  /**
   * What the gamepad shows now; null: there is none.
   * @param {Pad|null} pad @param {number} now milliseconds @param {Mapping} [mapping]
   */
  padSample(pad, now, mapping = USUAL) {
    if (pad === null) return this.padGone();
    const sample = padVector(pad, mapping);
    if (sample === null) return this.padGone();
    const neutral = sample.x === 0 && sample.z === 0 && sample.y === 0;
    const stamp = [pad.timestamp, sample.x, sample.z, sample.y].join();
    if (stamp !== this.padStamp || neutral) {
      this.padStamp = stamp;
      this.padMovedAt = now;
      this.padFrozen = false;
    } else if (this.padArmed && now - this.padMovedAt > FROZEN_MS) {
      this.padFrozen = true;
      this.padArmed = false;
    }
    if (neutral) this.padArmed = true;
    this.pad = this.padArmed ? sample : { x: 0, z: 0, y: 0 };
  }

  padGone() {
    this.pad = { x: 0, z: 0, y: 0 };
    this.padArmed = this.padFrozen = false;
  }

  /** What is held counts again after it was released. */
  clear() {
    this.clearKeys();
    this.held.clear();
    const dragged = this.pointer !== null || this.waiting.has("stick");
    this.stickEnd();
    if (dragged) this.waiting.add("stick");
    this.pad = { x: 0, z: 0, y: 0 };
    this.padArmed = false;
  }

  clearKeys() {
    for (const code of this.keys) this.waiting.add(code);
    this.keys.clear();
  }

  /** The keyboard belongs to another window now: releases will not be seen. */
  leave() {
    this.clear();
    this.waiting.clear();
  }

  /** Whether everything is released, as far as is known. A gamepad that is not armed may never be neutral. */
  get neutral() {
    const { stick, pad } = this;
    const still = !stick.x && !stick.z && !pad.x && !pad.z && !pad.y;
    return still && this.pointer === null && !this.keys.size && !this.waiting.size && !this.held.size;
  }

  /** Whether a key, or the gamepad, asks for motion: these need the focus of the window. */
  get fromKeys() {
    return this.keys.size > 0 || this.pad.x !== 0 || this.pad.z !== 0 || this.pad.y !== 0;
  }

  /**
   * The wanted motion: steering x and throttle z as the original page mixes them, and the auxiliary axis y.
   * @param {Sliders} sliders
   */
  vector(sliders) {
    const x = limit(this.axis(RIGHT, LEFT) + this.stick.x + this.pad.x) * sliders.turn;
    const z = limit(this.axis(FORWARD, BACK) + this.stick.z + this.pad.z) * sliders.speed;
    let y = this.axis(UP, DOWN) + this.pad.y;
    for (const value of this.held.values()) y += value;
    return { ...balanced(x, z, sliders.balance), y: limit(y) * sliders.speed };
  }

  axis(plus, minus) {
    return Number(plus.some((code) => this.keys.has(code))) - Number(minus.some((code) => this.keys.has(code)));
  }
}

/**
 * What the stick of a gamepad asks for.
 * @param {Pad} pad @param {Mapping} mapping @returns {{x: number, z: number, y: number} | null} null: it has no such axes
 */
export function padVector({ axes, buttons }, { x, z, buttons: { auxiliary } }) {
  const read = ({ axis, invert }) => zone(axes[axis], PAD_DEAD_ZONE) * (invert ? -1 : 1);
  if (![x, z].every(({ axis }) => Number.isFinite(axes[axis]))) return null;
  const [across, ahead] = [read(x) + 0, read(z) + 0]; // without -0
  return buttons[auxiliary]?.pressed === true ? { x: 0, z: ahead, y: across } : { x: across, z: ahead, y: 0 };
}

/** Scale left and right wheels apart, for robots that pull to one side. */
export function balanced(x, z, balance) {
  const left = (z + x) * Math.min(1, 1 + balance);
  const right = (z - x) * Math.min(1, 1 - balance);
  const most = Math.max(1, Math.abs(left), Math.abs(right));
  return { x: (left - right) / 2 / most, z: (left + right) / 2 / most };
}

function zone(value, dead = DEAD_ZONE) {
  const size = Math.abs(value);
  return !(size > dead) ? 0 : Math.sign(value) * Math.min(1, (size - dead) / (1 - dead));
}

function limit(value) {
  return Math.max(-1, Math.min(1, value));
}

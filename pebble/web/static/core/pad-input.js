/** Lets gamepads drive: from what the browser shows of them to inputs, actions and stops. */

import { attempt } from "./browser.js";
import { PadChoice } from "./pad-choice.js";
import { reason } from "./reasons.js";

const PAD_TEXTS = {
  axes: "is ignored: it has no stick",
  "stop-held": "stops no more: its STOP is pressed all the time",
  focus: "is ignored: click this page first. Its STOP counts",
  "off-centre": "is ignored: its stick is not in the middle",
  release: "is ignored: let its stick go first",
  held: "count once they were let go",
  copy: "is ignored: it does what the one that drives does",
  other: "is ignored: another one drives",
};

/**
 * Why a gamepad is ignored, or some of its buttons are.
 * @param {{pad: {id: string, index: number}, code: import("./pad-choice.js").PadCode, buttons: number[]}} ignored @returns {import("./reasons.js").Reason}
 */
export function padReason({ pad, code, buttons }) {
  const name = pad.id.split(" (")[0].slice(0, 24).trim(); // without its numbers and its layout
  const some = code === "held" ? `buttons ${buttons.map((index) => index + 1).join(", ")} of ` : "";
  const text = `${some}gamepad ${pad.index + 1} (${name}) ${PAD_TEXTS[code]}`;
  return reason(`pad-${code}`, text[0].toUpperCase() + text.slice(1));
}

export class PadInput {
  /** @param {import("./driver.js").Driver} driver @param {import("./pad-choice.js").MappingOf} mappingOf */
  constructor(driver, mappingOf) {
    this.driver = driver;
    this.mappingOf = mappingOf;
    this.choice = new PadChoice();
  }

  /** The one that drives, or would; null: there is none. */
  get pad() {
    return this.choice.pad;
  }

  /** @param {readonly any[]} shown with holes @param {number} now milliseconds */
  read(shown, now) {
    const { driver, choice } = this;
    if (choice.see(shown.flatMap(plain), now)) driver.latch("gamepad"); // before all that may fail
    const focused = document.hasFocus();
    const { x, z, y } = driver.inputs.pad;
    const drives = x !== 0 || z !== 0 || y !== 0;
    const { stop, changed, act } = choice.choose(now, this.mappingOf, focused, drives);
    if (stop) driver.space();
    if (changed) this.handOver(act, drives);
    const pad = focused ? this.pad : null;
    const mapping = pad ? this.mappingOf(pad.id) : undefined;
    driver.inputs.padSample(pad, now, mapping);
    driver.actions?.padSample(pad, mapping);
  }

  /** Let this gamepad drive, once it was let go. @param {string} key as PadChoice has it */
  pick(key) {
    this.choice.pick(key);
    this.driver.inputs.padGone();
    this.driver.interrupt();
  }

  /** Another gamepad drives now. One that left neutral while nothing moved goes on from there; else it is let go first. */
  handOver(act, drove) {
    const { driver, pad } = this;
    driver.inputs.padGone();
    if (drove) driver.interrupt();
    else driver.inputs.padArmed = act === "left";
    if (!pad || !act) return;
    const before = pad.buttons.map((one, index) => (act === `button ${index}` ? { pressed: false } : one));
    driver.actions?.padSample({ ...pad, buttons: before }, this.mappingOf(pad.id)); // what was pressed counts at once
  }

  /** Which gamepads are ignored, and why. @returns {import("./reasons.js").Reason[]} */
  reasons() {
    const { padArmed } = this.driver.inputs;
    return this.choice.ignored(performance.now(), document.hasFocus(), padArmed).map(padReason);
  }
}

/** A gamepad as browsers of any age show it. @returns {import("./inputs.js").Pad[]} none, or one */
function plain(pad, place) {
  const read = (name, otherwise) => attempt(() => pad[name], otherwise);
  if (!pad || read("connected", true) === false) return [];
  const listed = (name, as) => attempt(() => Array.from(pad[name], as), []);
  const number = (value) => attempt(() => Number(value), NaN);
  const pressed = (one) => attempt(() => Number(one?.pressed ?? one) > 0.5 || one?.value > 0.5, false);
  return [
    {
      id: String(read("id", "")),
      index: number(read("index", place)),
      mapping: String(read("mapping", "")),
      timestamp: number(read("timestamp", 0)),
      axes: listed("axes", number),
      buttons: listed("buttons", (one) => ({ pressed: pressed(one) })),
    },
  ];
}

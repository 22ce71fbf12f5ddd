/** Lets a gamepad drive: the first one whose layout is known, else the first one with a stick. */

import { attempt } from "./browser.js";
import { MAPPINGS, mappingOf, padName, padVector } from "./inputs.js";
import { reason } from "./reasons.js";

/** @typedef {import("./inputs.js").Pad} Pad */

export class Pads {
  /** @param {import("./driver.js").Driver} driver */
  constructor(driver) {
    this.driver = driver;
    this.key = ""; // of the one that drives, or would
    /** @type {{key: string, pad: Pad, far: number}[]} those with a stick, and how far it is from the middle */
    this.usable = [];
  }

  /** @returns {Pad | null} the one that drives, or would */
  get pad() {
    return this.usable.find(({ key }) => key === this.key)?.pad ?? null;
  }

  /** @param {readonly any[]} shown with holes @param {number} now milliseconds */
  read(shown, now) {
    const { driver } = this;
    this.usable = shown.flatMap((pad, place) => {
      const far = attempt(() => (pad.connected === false ? -1 : distance(pad)), -1);
      return far < 0 ? [] : [{ key: `${place} ${pad.id}`, pad, far }];
    });
    const known = this.usable.filter(({ pad }) => isKnown(pad));
    const candidates = known.length ? known : this.usable;
    const { key } = candidates.find((candidate) => candidate.key === this.key) ?? candidates[0] ?? { key: "" };
    if (key !== this.key) driver.inputs.padGone(); // it drives after it was seen in neutral
    this.key = key;
    const pad = document.hasFocus() ? this.pad : null;
    const mapping = pad ? mappingOf(pad) : undefined;
    driver.inputs.padSample(pad, now, mapping);
    driver.actions?.padSample(pad, mapping);
  }

  /** @returns {import("./reasons.js").Reason[]} why gamepads whose sticks are pushed do not drive */
  reasons() {
    const { padArmed } = this.driver.inputs;
    return this.usable.flatMap(({ key, pad, far }) => {
      if (!far) return [];
      const name = `Gamepad ${pad.index + 1} (${padName(pad)})`;
      if (key !== this.key) return isKnown(pad) ? [reason("pad-other", `${name} is ignored: only the first one drives. Its STOP counts`)] : [];
      if (!document.hasFocus()) return [reason("pad-focus", `${name} is ignored: click this page first. Its STOP counts`)];
      return padArmed ? [] : [reason("pad-release", `${name} is ignored: let its stick go first`)];
    });
  }
}

/** @param {Pad} pad */
const isKnown = (pad) => pad.mapping === "standard" || MAPPINGS.some(({ id }) => id.test(pad.id));

/** @param {Pad} pad @returns {number} of its stick from the middle, 0 to 1; -1: it has no stick */
function distance(pad) {
  const vector = padVector(pad, mappingOf(pad));
  return vector ? Math.max(...Object.values(vector).map(Math.abs)) : -1;
}

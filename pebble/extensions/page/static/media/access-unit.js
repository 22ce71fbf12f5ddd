// Access units of H.264: their NAL units, and the codec string of a key frame. Pure.

import { MAX_BYTES } from "./jpeg.js";

const [IDR, SPS, PPS] = [5, 7, 8];

/**
 * Throws an Error unless this is Annex B, and a key frame exactly if `keyframe`.
 * @param {Uint8Array} unit
 * @param {boolean} keyframe
 * @returns {string|null} the codec string of a key frame, "avc1.42E01E"
 */
export function checkUnit(unit, keyframe) {
  if (unit.length > MAX_BYTES) throw new Error(`h264: ${unit.length} bytes, more than ${MAX_BYTES}`);
  if (!(unit[0] === 0 && unit[1] === 0 && (unit[2] === 1 || (unit[2] === 0 && unit[3] === 1)))) {
    throw new Error("h264: no start code");
  }
  const units = nalUnits(unit);
  const types = new Set(units.map(([type]) => type));
  if (keyframe && ![IDR, SPS, PPS].every((type) => types.has(type))) {
    throw new Error("h264: a key frame without its parameter sets or its picture");
  }
  if (!keyframe && (types.has(IDR) || types.has(SPS))) {
    throw new Error("h264: a key frame that is not marked as one");
  }
  const sps = units.find(([type]) => type === SPS);
  return sps ? codecString(unit, sps[1]) : null;
}

/**
 * Type and position of each NAL unit.
 * @param {Uint8Array} unit
 * @returns {Array<[number, number]>}
 */
function nalUnits(unit) {
  /** @type {Array<[number, number]>} */
  const found = [];
  for (let at = unit.indexOf(1, 2); at >= 0 && at + 1 < unit.length; at = unit.indexOf(1, at + 1)) {
    if (unit[at - 1] === 0 && unit[at - 2] === 0) found.push([unit[at + 1] & 31, at + 1]);
  }
  return found;
}

/** Profile, constraints and level are the three bytes after the SPS's type. */
function codecString(/** @type {Uint8Array} */ unit, /** @type {number} */ at) {
  const bytes = [unit[at + 1], unit[at + 2], unit[at + 3]].map((byte) => (byte ?? 0).toString(16).padStart(2, "0"));
  return `avc1.${bytes.join("")}`;
}

/** Mappings of gamepads as this browser remembers them. Pure. */

import { PAD_ESTOP, USUAL } from "./inputs.js";

export const MOST = 32; // axes, and buttons

const isIndex = (value) => Number.isInteger(value) && value >= -1 && value < MOST;

/** @param {any} value that was stored, perhaps by another version @returns {import("./inputs.js").Mapping} the usual one for what is none */
export function validMapping(value) {
  const axis = (one) => ({ axis: one?.axis, invert: one?.invert === true });
  const [x, z, deadZone] = [axis(value?.x), axis(value?.z), Number(value?.deadZone)];
  const valid = isIndex(x.axis) && isIndex(z.axis) && x.axis !== z.axis && deadZone >= 0.02 && deadZone < 0.6;
  if (!valid) return USUAL;
  const kept = Object.entries(value.buttons ?? {}).filter(([, at]) => isIndex(at) && !PAD_ESTOP.includes(at));
  return { x, z, deadZone, buttons: { ...USUAL.buttons, ...Object.fromEntries(kept.slice(0, MOST)) } };
}

// A self-describing microcontroller: what its commands hold. The server has checked its manifest. Pure.

import { inner } from "../parts/words.js";

/** @type {Record<string, [number, number]>} */
const RANGES = {
  u8: [0, 2 ** 8 - 1],
  i8: [-(2 ** 7), 2 ** 7 - 1],
  u16: [0, 2 ** 16 - 1],
  i16: [-(2 ** 15), 2 ** 15 - 1],
  u32: [0, 2 ** 32 - 1],
  i32: [-(2 ** 31), 2 ** 31 - 1],
};

/** @typedef {{name: string, type?: string, scale?: number, offset?: number, unit?: string}} Field */

/**
 * ``local_only``: its values and commands stay on the robot.
 * @typedef {{name: string, dir: "in" | "out", kind?: string, channel?: string, profile?: string, rate_hz?: number,
 *   local_only?: boolean, encoding: {fields: Field[]}}} Interface
 */

/** The value of one field in a payload of an interface. @param {any} payload @param {string} name */
export const fieldOf = (payload, name) => inner(payload)?.[name];

/** Why this interface takes no command from a page; "" it does. @param {Interface} one */
export function unsendable(one) {
  if (one.local_only) return "it takes commands from its own robot only";
  const odd = one.encoding.fields.find(({ type }) => type !== "bool" && type !== "f32" && !Object.hasOwn(RANGES, type));
  return odd ? `${odd.name} is of an unknown type` : "";
}

/** The least and the greatest value. @param {Field} field @returns {[number, number] | null} null: no bound worth saying */
export function range({ type, scale = 1, offset = 0 }) {
  if (!Object.hasOwn(RANGES, type)) return null;
  const [a, b] = RANGES[type].map((raw) => Number((raw * scale + offset).toPrecision(12)));
  return a < b ? [a, b] : [b, a];
}

/** The step of an input element. @param {Field} field @returns {string} */
export function step({ type, scale = 1, offset = 0 }) {
  if (type === "f32" || offset % scale) return "any";
  return String(Math.abs(Number(scale.toPrecision(6))));
}

/**
 * The value of a command, with exactly the fields that are declared. What they cannot hold, the browser has refused.
 * @param {Interface} one @param {Map<string, string | boolean>} entered by name of the field
 */
export const command = ({ encoding: { fields } }, entered) =>
  Object.fromEntries(fields.map(({ name, type }) => [name, type === "bool" ? entered.get(name) === true : Number(entered.get(name))]));

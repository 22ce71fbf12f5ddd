// A self-describing microcontroller: what its commands hold. The server has checked its manifest. Pure.

import { plain } from "../parts/more-words.js";
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
const LARGEST_F32 = 3.4028234e38;

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
 * What was entered, as JSON: a boolean, or a number that the field can hold. One that is scaled is rounded by the robot.
 * @param {Field} field @param {string | boolean | undefined} entered
 * @returns {{value: boolean | number} | {problem: string}}
 */
export function parse(field, entered) {
  if (field.type === "bool") return { value: entered === true };
  const written = typeof entered === "string" ? entered.trim() : "";
  const limits = range(field);
  const { scale = 1, offset = 0 } = field;
  const unit = field.unit ? ` ${field.unit}` : "";
  const wanted = limits ? `${plainNumber(limits[0])} to ${plainNumber(limits[1])}${unit}` : `a number${unit}`;
  const problem = { problem: `${field.name}: ${wanted}` };
  const value = Number(written);
  if (!written || !Number.isFinite(value)) return problem;
  if (!limits) return Math.abs((value - offset) / scale) > LARGEST_F32 ? problem : { value };
  if (value < limits[0] || value > limits[1]) return problem;
  const isPlain = scale === 1 && offset === 0;
  return isPlain && !Number.isInteger(value) ? { problem: `${field.name}: a whole number, ${wanted}` } : { value };
}

const plainNumber = (value) => String(Number(value.toPrecision(10)));

/**
 * The value of a command, with exactly the fields that are declared; or what is wrong with it.
 * @param {Interface} one @param {Map<string, string | boolean>} entered by name of the field
 * @returns {{value: Record<string, boolean | number>, problems: string[]}}
 */
export function command(one, entered) {
  const parsed = one.encoding.fields.map((field) => /** @type {const} */ ([field.name, parse(field, entered.get(field.name))]));
  const problems = parsed.flatMap(([, result]) => ("problem" in result ? [result.problem] : []));
  const values = parsed.flatMap(([name, result]) => ("value" in result ? [[name, result.value]] : []));
  return { value: Object.fromEntries(values), problems };
}

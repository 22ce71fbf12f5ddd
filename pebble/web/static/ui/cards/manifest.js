// What a self-describing microcontroller says of itself, read with suspicion, and values for its commands. Pure.

import { plain } from "../parts/more-words.js";
import { inner, isObject } from "../parts/words.js";

export const MAX_INTERFACES = 64;
export const MAX_FIELDS = 32; // of one interface
const MAX_NAME = 255; // characters of a field's name
const MAX_SENT = 12_000; // characters of one command: the server takes no more
const LONG = 80; // characters of a text

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

/** @typedef {{name: string, type: string, scale: number, offset: number, unit: string}} Field */

/**
 * ``omitted``: so many of its fields are beyond the limit; ``isWhole``: the others could be read. ``isPrivate``: its
 * values and commands stay on the robot.
 * @typedef {{name: string, label: string, isOut: boolean, kind: string, channel: string, profile: string,
 *   rateHz: number, isPrivate: boolean, fields: Field[], omitted: number,
 *   isWhole: boolean}} Interface
 */

/** @typedef {{model: string, firmware: string, interfaces: Interface[], omitted: number}} Manifest */

/** @param {unknown} payload of ``mcu/{uid}/describe`` @returns {Manifest | null} null: it cannot be read */
export function readManifest(payload) {
  const value = inner(payload);
  if (!isObject(value) || !Array.isArray(value.interfaces)) return null;
  const kept = value.interfaces.slice(0, MAX_INTERFACES);
  const interfaces = kept.map(readInterface).filter((one) => one !== null);
  const omitted = value.interfaces.length - kept.length;
  return { model: text(value.model), firmware: text(value.firmware_version), interfaces, omitted };
}

/** @returns {Interface | null} */
function readInterface(one) {
  if (!isObject(one) || typeof one.name !== "string" || !one.name || !["in", "out"].includes(one.dir)) return null;
  const listed = isObject(one.encoding) && Array.isArray(one.encoding.fields) ? one.encoding.fields : [];
  const read = listed.slice(0, MAX_FIELDS).map(readField);
  const fields = unique(read.filter((field) => field !== null));
  return {
    name: one.name,
    label: text(one.name),
    isOut: one.dir === "out",
    kind: text(one.kind),
    channel: typeof one.channel === "string" ? one.channel : "",
    profile: text(one.profile),
    rateHz: Number.isFinite(one.rate_hz) ? one.rate_hz : 0,
    isPrivate: one.local_only !== undefined && one.local_only !== false,
    fields,
    omitted: listed.length - read.length,
    isWhole: fields.length === read.length,
  };
}

/** @returns {Field | null} */
function readField(one) {
  if (!isObject(one) || typeof one.name !== "string" || !one.name || one.name.length > MAX_NAME) return null;
  const type = typeof one.type === "string" ? one.type : "";
  const scale = Number.isFinite(one.scale) && one.scale !== 0 ? one.scale : 1;
  const offset = Number.isFinite(one.offset) ? one.offset : 0;
  return { name: one.name, type, scale, offset, unit: text(one.unit) };
}

/** @param {Field[]} fields @returns {Field[]} */
function unique(fields) {
  const names = new Set();
  return fields.filter(({ name }) => !names.has(name) && names.add(name));
}

/** One short line, whatever it is. @param {unknown} value @returns {string} */
export function text(value) {
  const whole = typeof value === "string" ? value : value === undefined || value === null ? "" : plain(value);
  return whole.length > LONG ? `${whole.slice(0, LONG)}…` : whole;
}

/** The value of one field in a payload of an interface. @param {unknown} payload @param {string} name */
export function fieldOf(payload, name) {
  const value = inner(payload);
  return isObject(value) && Object.hasOwn(value, name) ? value[name] : undefined;
}

/** Why this interface takes no command from a page; "" it does. @param {Interface} one */
export function unsendable(one) {
  if (one.isPrivate) return "it takes commands from its own robot only";
  if (one.omitted) return `it has more than ${MAX_FIELDS} fields: use pebble topic pub`;
  if (!one.isWhole) return "one of its fields cannot be read";
  const odd = one.fields.find(({ type }) => type !== "bool" && type !== "f32" && !Object.hasOwn(RANGES, type));
  return odd ? `${text(odd.name)} is of an unknown type` : "";
}

/** The least and the greatest value. @param {Field} field @returns {[number, number] | null} null: no bound worth saying */
export function range({ type, scale, offset }) {
  if (!Object.hasOwn(RANGES, type)) return null;
  const [a, b] = RANGES[type].map((raw) => Number((raw * scale + offset).toPrecision(12)));
  return a < b ? [a, b] : [b, a];
}

/** The step of an input element. @param {Field} field @returns {string} */
export function step({ type, scale, offset }) {
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
  const unit = field.unit && ` ${field.unit}`;
  const wanted = limits ? `${plainNumber(limits[0])} to ${plainNumber(limits[1])}${unit}` : `a number${unit}`;
  const problem = { problem: `${text(field.name)}: ${wanted}` };
  const value = Number(written);
  if (!written || !Number.isFinite(value)) return problem;
  if (!limits) return Math.abs((value - field.offset) / field.scale) > LARGEST_F32 ? problem : { value };
  if (value < limits[0] || value > limits[1]) return problem;
  const isPlain = field.scale === 1 && field.offset === 0;
  return isPlain && !Number.isInteger(value) ? { problem: `${text(field.name)}: a whole number, ${wanted}` } : { value };
}

const plainNumber = (value) => String(Number(value.toPrecision(10)));

/**
 * The value of a command, with exactly the fields that are declared; or what is wrong with it.
 * @param {Interface} one @param {Map<string, string | boolean>} entered by name of the field
 * @returns {{value: Record<string, boolean | number>, problems: string[]}}
 */
export function command(one, entered) {
  const parsed = one.fields.map((field) => /** @type {const} */ ([field.name, parse(field, entered.get(field.name))]));
  const problems = parsed.flatMap(([, result]) => ("problem" in result ? [result.problem] : []));
  const values = parsed.flatMap(([name, result]) => ("value" in result ? [[name, result.value]] : []));
  const value = Object.fromEntries(values);
  if (JSON.stringify(value).length > MAX_SENT) problems.push("it is too long to be sent");
  return { value, problems };
}

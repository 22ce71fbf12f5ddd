// The settings of a script: which come first, what was typed, and what is sent. The server has checked what a robot lists.

import { read, write } from "../parts/models.js";
import { plain } from "../parts/more-words.js";

const MOST_MAIN = 3; // settings of a script before the others

/**
 * One setting, as pebble/extensions/operator/client/forms.py lists it. ``default`` is null where there is none.
 * @typedef {{key: string, label: string, type: "string" | "int" | "float" | "bool" | "enum",
 *   default: string | number | boolean | null, required?: boolean, min?: number, max?: number, step?: number,
 *   options?: string[]}} Field
 */

/** What was typed, by key: only what is not the default. @typedef {Map<string, string>} Texts */

/**
 * ``summary`` says what it does; ``main`` are the fields that come first, ``more`` the others.
 * @typedef {{file: string, label: string, summary: string, fields: Field[], main: Field[], more: Field[]}} Script
 */

/** @param {any} payload of autonomy-files @returns {Script[] | null} null: none was received */
export function scripts(payload) {
  if (!payload?.files) return null;
  const { files } = payload;
  return files.map(({ file, label = file, summary = "", main, configs: fields }) => {
    const isShared = files.some((other) => other.file !== file && other.label === label);
    return { file, label: isShared ? `${label} (${file})` : label, summary, fields, ...divided(fields, main) };
  });
}

/** The fields that come first, and the others. @param {Field[]} fields @param {string[]} [named] by the script */
function divided(fields, named = []) {
  const chosen = named.slice(0, MOST_MAIN).map((key) => fields.find((one) => one.key === key)).filter(Boolean);
  const main = new Set(chosen.length ? chosen : fields.slice(0, MOST_MAIN));
  for (const one of fields) if (isMissing(one)) main.add(one);
  return { main: [...main], more: fields.filter((one) => !main.has(one)) };
}

/** @param {Field} field @returns {boolean} whether a person has to fill it in */
export const isMissing = (field) => field.required === true && field.default === null;

/** The text of its default; "" it has none. @param {Field} field */
export const usual = (field) => String(field.default ?? "");

/** What is sent, with the types of JSON: only what was filled in. @param {Field[]} fields @param {Texts} texts */
export function filled(fields, texts) {
  return Object.fromEntries(fields.filter(({ key }) => texts.has(key)).map((one) => [one.key, typed(one, texts.get(one.key))]));
}

function typed({ type }, text) {
  if (type === "bool") return text === "true";
  return type === "int" || type === "float" ? Number(text) : text;
}

/** @param {Field} field @returns {string} what it accepts; "" anything */
export function hint({ type, min, max }) {
  if (type !== "int" && type !== "float") return "";
  const noun = type === "int" ? "A whole number" : "A number";
  if (min !== undefined && max !== undefined) return `${noun} from ${min} to ${max}`;
  if (min !== undefined) return `${noun}, at least ${min}`;
  return max === undefined ? noun : `${noun}, at most ${max}`;
}

/** @param {Field[]} fields @param {Texts} texts @returns {string} how many more there are, and how many were changed */
export function moreWords(fields, texts) {
  const changed = fields.filter(({ key }) => texts.has(key)).length;
  return `${fields.length} more ${fields.length === 1 ? "option" : "options"}${changed ? `, ${changed} changed` : ""}`;
}

/** @param {Field["type"]} type @param {string} value @returns {string} as people read it */
export const option = (type, value) => (type === "bool" ? (value === "true" ? "on" : "off") : plain(value));

// -- what was typed, in this browser

const MOST_FORMS = 32;

/** @param {string} ref @param {string} file @returns {Texts} */
export function remembered(ref, file) {
  const found = forms().find((one) => one[0] === ref && one[1] === file);
  return new Map(found?.[2] ?? []);
}

/**
 * The newest forms are remembered, of all robots together.
 * @param {string} ref @param {string} file @param {Texts} texts
 */
export function remember(ref, file, texts) {
  const others = forms().filter((one) => one[0] !== ref || one[1] !== file);
  write("forms", [[ref, file, [...texts]], ...others].slice(0, MOST_FORMS));
}

/** @returns {[string, string, [string, string][]][]} robot, script and texts, the newest first */
function forms() {
  const stored = read("forms", []);
  return Array.isArray(stored) ? stored.filter(isForm) : [];
}

function isForm(one) {
  const isText = (value) => typeof value === "string";
  const isPair = (pair) => Array.isArray(pair) && pair.length === 2 && pair.every(isText);
  return Array.isArray(one) && isText(one[0]) && isText(one[1]) && Array.isArray(one[2]) && one[2].every(isPair);
}

// The settings of a script: what a robot lists of them, what was typed, and what is sent. Robots may list anything.

import { read, write } from "../parts/models.js";
import { plain } from "../parts/more-words.js";
import { inner, isObject } from "../parts/words.js";

const MOST_SCRIPTS = 256; // of one robot; robots list no more
const MOST_FIELDS = 64; // of one script; robots list no more
const MOST_OPTIONS = 200; // of one setting
const MOST_MAIN = 3; // settings of a script before the others
const LONGEST_TEXT = 256; // characters; robots accept no more
const LONGEST_KEY = 100;
const LONGEST_CONFIG = 14_000; // characters of JSON: the server reads messages of 16 KB
const LARGEST_INT = 1e15;
const NOT_PRINTABLE = /\p{C}|(?! )\p{Z}/u;

/**
 * One setting. ``default`` is null where there is none; ``options`` are the values of a choice.
 * @typedef {{key: string, label: string, type: "text" | "int" | "float" | "bool" | "enum", default: string | null,
 *   required: boolean, min: number | null, max: number | null, step: number | null, options: string[]}} Field
 */

/** What was typed, by key: only what is not the default. @typedef {Map<string, string>} Texts */

/** The text of a number that is none yet, as a lone sign: browsers do not report it. */
export const UNREADABLE = "?";

/** Nothing was filled in yet where something has to be: no mistake of a person's. */
export const MISSING = "required";

/**
 * ``summary`` says what it does; ``main`` are the fields that come first, ``more`` the others.
 * @typedef {{file: string, label: string, summary: string, fields: Field[], main: Field[], more: Field[], omitted: number}} Script
 */

/** @param {unknown} payload of autonomy-files @returns {Script[] | null} null: none was received */
export function scripts(payload) {
  const files = inner(payload)?.files;
  if (!Array.isArray(files)) return null;
  const named = files.filter((one) => isObject(one) && isName(one.file, 200)).slice(0, MOST_SCRIPTS);
  return unique(named, ({ file }) => file).map((one) => {
    const configs = Array.isArray(one.configs) ? one.configs : [];
    const usable = configs.filter((entry) => isObject(entry) && isName(entry.key, LONGEST_KEY));
    const found = unique(usable, ({ key }) => key).slice(0, MOST_FIELDS).map(field);
    const label = isName(one.label, 100) ? one.label : one.file;
    const isShared = named.some((other) => other.file !== one.file && other.label === label);
    return {
      file: one.file,
      label: isShared ? `${label} (${one.file})` : label,
      summary: isName(one.summary, LONGEST_TEXT) ? one.summary : "",
      fields: found,
      ...divided(found, one.main),
      omitted: configs.length - found.length,
    };
  });
}

/** The fields that come first, and the others. @param {Field[]} fields @param {unknown} named by the script */
function divided(fields, named) {
  const keys = Array.isArray(named) ? named.slice(0, MOST_MAIN) : [];
  const chosen = keys.map((key) => fields.find((one) => one.key === key)).filter(Boolean);
  const main = [...new Set(chosen.length ? chosen : fields.slice(0, MOST_MAIN))];
  main.push(...fields.filter((one) => one.required && one.default === null && !main.includes(one)));
  return { main, more: fields.filter((one) => !main.includes(one)) };
}

const isName = (value, longest) => typeof value === "string" && value.trim() !== "" && value.length <= longest;

const unique = (list, key) => [...new Map(list.map((one) => [key(one), one])).values()];

/** @param {Record<string, any>} entry @returns {Field} */
function field(entry) {
  const listed = Array.isArray(entry.options) ? entry.options.slice(0, MOST_OPTIONS) : [];
  const options = [...new Set(listed.filter(isScalar).map(String))];
  const type = typeOf(entry.type, options);
  const limit = (name) => (type !== "enum" && Number.isFinite(entry[name]) ? entry[name] : null);
  return {
    key: entry.key,
    label: isName(entry.label, 100) ? entry.label : entry.key,
    type,
    default: isScalar(entry.default) ? String(entry.default) : null,
    required: entry.required === true,
    min: limit("min"),
    max: limit("max"),
    step: limit("step") > 0 ? limit("step") : null,
    options: type === "bool" ? ["true", "false"] : options,
  };
}

const isScalar = (value) => ["string", "number", "boolean"].includes(typeof value);

/** @param {unknown} type @param {string[]} options @returns {Field["type"]} */
function typeOf(type, options) {
  if (type === "enum") return options.length ? "enum" : "text";
  return type === "int" || type === "float" || type === "bool" ? type : "text";
}

/** What is wrong with a text, for people; "" nothing. @param {Field} field @param {string} text @returns {string} */
export function mistake(field, text) {
  if (text === "") return field.required && field.default === null ? MISSING : "";
  switch (field.type) {
    case "int":
    case "float":
      return wrongNumber(field, text);
    case "bool":
    case "enum":
      return field.options.includes(text) ? "" : "choose one of the list";
    default:
      return wrongText(text);
  }
}

function wrongNumber({ type, min, max }, text) {
  const number = Number(text);
  if (!/\d/.test(text) || !Number.isFinite(number)) return "must be a number";
  if (type === "int" && (!Number.isInteger(number) || Math.abs(number) >= LARGEST_INT)) return "must be a whole number";
  if (min !== null && number < min) return `at least ${min}`;
  if (max !== null && number > max) return `at most ${max}`;
  return "";
}

function wrongText(text) {
  if (text.length > LONGEST_TEXT) return `at most ${LONGEST_TEXT} characters`;
  if (text.startsWith("-")) return "must not begin with -";
  return NOT_PRINTABLE.test(text) ? "must have no control characters" : "";
}

/**
 * What is sent, with the types of JSON: only what was filled in, and what is wrong by key.
 * @param {Field[]} fields @param {Texts} texts
 * @returns {{config: Record<string, string | number | boolean>, mistakes: Map<string, string>}}
 */
export function filled(fields, texts) {
  const mistakes = new Map();
  const values = [];
  for (const one of fields) {
    const text = texts.get(one.key) ?? "";
    const wrong = mistake(one, text);
    if (wrong) mistakes.set(one.key, wrong);
    else if (text !== "") values.push([one.key, typed(one, text)]);
  }
  return { config: Object.fromEntries(values), mistakes };
}

function typed({ type }, text) {
  if (type === "bool") return text === "true";
  return type === "int" || type === "float" ? Number(text) : text;
}

/** @param {{config: object, mistakes: Map<string, string>}} form @returns {string} why it cannot be sent; "" it can */
export function whyNotSent({ config, mistakes }) {
  const wrong = [...mistakes.values()].filter((one) => one !== MISSING).length;
  if (wrong) return `The form has ${wrong === 1 ? "1 mistake" : `${wrong} mistakes`}`;
  if (mistakes.size) return "Fill in what is required";
  return JSON.stringify(config).length > LONGEST_CONFIG ? "The settings are too long together" : "";
}

/** @param {Field} field @returns {string} what it accepts, for one that holds something else; "" anything */
export function hint({ type, min, max }) {
  if (type !== "int" && type !== "float") return "";
  const noun = type === "int" ? "A whole number" : "A number";
  if (min !== null && max !== null) return `${noun} from ${min} to ${max}`;
  if (min !== null) return `${noun}, at least ${min}`;
  return max === null ? noun : `${noun}, at most ${max}`;
}

/** @param {Field[]} fields @param {Texts} texts @returns {string} how many more there are, and how many were changed */
export function moreWords(fields, texts) {
  const changed = fields.filter(({ key }) => texts.has(key)).length;
  const usual = fields.length === 1 ? "at its default" : "all at their defaults";
  return `${fields.length} more, ${changed ? `${changed} changed` : usual}`;
}

/** @param {Field["type"]} type @param {string} value @returns {string} as people read it */
export const option = (type, value) => (type === "bool" ? (value === "true" ? "on" : "off") : plain(value));

// -- what was typed, in this browser

const MOST_FORMS = 32;
const LONGEST_FORMS = 60_000; // characters of JSON

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
  const readable = [...texts].filter(([, text]) => text !== UNREADABLE);
  const newest = [[ref, file, readable], ...others].slice(0, MOST_FORMS);
  while (newest.length > 1 && JSON.stringify(newest).length > LONGEST_FORMS) newest.pop();
  write("forms", newest);
}

/** @param {string} ref @returns {string} the script whose form was used last; "" none */
export const lastScript = (ref) => forms().find((one) => one[0] === ref)?.[1] ?? "";

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

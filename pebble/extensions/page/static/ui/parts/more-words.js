// How values are written of which the first screen shows none; see words.js.

import { clockTime, inner, isObject } from "./words.js";

const short = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit" });

/** @param {number} ms epoch @returns {string} 12:03 */
export const shortTime = (ms) => short.format(ms);

/** @param {number} ms epoch @returns {string} 10:03:12.345 */
export const exactTime = (ms) => `${clockTime(ms)}.${String(Math.floor(ms) % 1000).padStart(3, "0")}`;

/** @param {unknown} payload of charging-status @returns {string} "": it is not known */
export function charging(payload) {
  const value = inner(payload);
  return value === true ? "charging" : value === false ? "not charging" : "";
}

const MAX_TEXT = 400;

/** One line for any JSON value. @param {unknown} value @returns {string} */
export function plain(value) {
  if (typeof value === "number") return String(Math.abs(value) < 1e5 ? Number(value.toPrecision(5)) : Math.round(value));
  if (value === null || value === undefined) return "–";
  if (typeof value !== "object") return cut(String(value));
  if (Array.isArray(value)) return cut(`[${value.slice(0, 40).map(plain).join(", ")}]`);
  return cut(Object.entries(value).slice(0, 40).map(([key, one]) => `${key} ${nested(one)}`).join(" · "));
}

const nested = (value) => (isObject(value) ? `{${plain(value)}}` : plain(value));

const cut = (text) => (text.length > MAX_TEXT ? `${text.slice(0, MAX_TEXT)}…` : text);

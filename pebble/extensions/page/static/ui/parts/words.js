// How values are written for people. Everything of a robot is text, whatever type it claims to be.

import { isObject, visible } from "../../core/json.js";

export { isObject, visible };

const time = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });

/** @param {string} ref @returns {string} the last level, its id: nameIn of looks.js is what people call it */
export const nameOf = (ref) => ref.slice(ref.lastIndexOf("/") + 1);

/** @param {string} ref @returns {string} "robots", "towers", … */
export const typeOf = (ref) => ref.split("/")[1] ?? "";

/** @param {string} ref @returns {string} "robot", "tower", … */
export const kindOf = (ref) => (typeOf(ref) === "people" ? "person" : typeOf(ref).replace(/s$/, ""));

/** @param {number} ms epoch @returns {string} 12:03:41 */
export const clockTime = (ms) => time.format(ms);

/** @param {number} ms @returns {string} 68 ms, 5.2 s, 18 min, 3 h, 2 days */
export function span(ms) {
  if (ms < 950) return `${Math.round(Math.max(0, ms))} ms`;
  if (ms < 10_000) return `${(ms / 1000).toFixed(1)} s`;
  if (ms < 120_000) return `${Math.round(ms / 1000)} s`;
  if (ms < 7_200_000) return `${Math.round(ms / 60_000)} min`;
  if (ms < 172_800_000) return `${Math.round(ms / 3_600_000)} h`;
  return `${Math.round(ms / 86_400_000)} days`;
}

/** As ``span``, without parts of seconds: for what is drawn once a second. @param {number} ms @returns {string} */
export const roughly = (ms) => (ms < 120_000 ? `${Math.max(0, Math.round(ms / 1000))} s` : span(ms));

/** @param {unknown} value @param {number} digits @returns {string} "–" for what is no number */
export const number = (value, digits) => (Number.isFinite(value) ? Number(value).toFixed(digits).replace(/^-(?=[0.]+$)/, "") : "–");

/** The payload without the envelope that most have. @param {unknown} payload @returns {any} */
export const inner = (payload) => (isObject(payload) && "value" in payload ? payload.value : payload);

const STREAM_KEYS = ["webrtc_url", "webrtcUrl", "url"]; // robots of the original use all of them

/** @param {any} status payload @returns {string} the address of a stream that it reports; "" none */
export function reported(status) {
  const value = inner(status);
  const key = isObject(value) && STREAM_KEYS.find((one) => value[one]);
  return key && typeof value[key] === "string" ? value[key] : "";
}

/** @param {unknown} payload of charging-level @param {number} [digits] of volts @returns {string} 7.92 V, 81 % */
export function battery(payload, digits = 2) {
  const value = inner(payload);
  const unit = isObject(payload) && typeof payload.unit === "string" ? payload.unit : "";
  if (unit.toLowerCase() === "v") return `${number(value, digits)} V`;
  return `${number(value, 1)}${unit ? ` ${unit}` : ""}`;
}

/** @param {any} view DriverView @returns {string} "bob (phone)" */
export function driverName(view) {
  return view.device ? `${view.by} (${view.device})` : view.by;
}

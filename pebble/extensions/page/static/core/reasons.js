/** Why a control is off, in one line for people; the first reason counts. Pure. */

export const PING_TIMEOUT_MS = 1500;
export const PICTURE_OLD_MS = 2000;
const IDLE_MS = 5500; // the server lets a driver be replaced after 5 s without a gesture
export const SLOW_MS = 300; // from this round trip on, the speed is limited
const LATE_MS = 600;
export const SLOW_SPEED = 0.4;
const RESET_MS = 600; // after a reset robots refuse a driver who has not paused for 0.5 s

/** @typedef {{running?: boolean, file?: string|null, label?: string, drives?: boolean, overridden?: boolean}} Script autonomy-status */
/** @typedef {{code: string, text: string, action?: Action, also?: Action}} Reason */
/** @typedef {{label: string, kind: "take"|"ask"|"give-up"|"take-over"|"see"|"login"|"reload"|"stop-script"}} Action */

/** @typedef {ReturnType<import("./driver.js").Driver["situation"]>} Situation */

/** Why nothing may be commanded at all. @param {Situation} s @returns {Reason|null} */
export function offReason(s) {
  if (!s.open) return s.connecting ? reason("connecting", "Connecting to the server…") : reason("server", "No connection to the server");
  if (s.broker) return say(s, "broker", { problem: s.broker });
  return null;
}

/** Why this component cannot be driven now. @param {Situation} s @returns {Reason|null} */
export function driveReason(s) {
  return offReason(s) ?? pageReason(s) ?? robotReason(s) ?? leaseReason(s) ?? momentReason(s);
}

function pageReason(s) {
  if (s.failed) return { ...say(s, "failed", { part: s.failed }), action: RELOAD };
  if (s.reload) return { ...say(s, "reload"), action: RELOAD };
  if (!s.drives) return say(s, "plain");
  if (!s.rights.includes("drive")) return { ...say(s, "role"), action: { label: "Log in", kind: "login" } };
  if (s.hidden) return say(s, "hidden");
  return null;
}

function robotReason(s) {
  if (!s.liveness || s.liveness.online === false) return say(s, "silent", { name: s.name, since: silence(s) });
  if (s.estop?.latched) return say(s, "stopped", { by: s.estop.by || "unknown" });
  if (s.freeForMs < RESET_MS) return say(s, "reset");
  const drive = s.capabilities.drive;
  if (drive?.available !== true || drive.controls === false) return say(s, "no-drive", { name: s.name });
  return null;
}

function silence(s) {
  const since = s.liveness?.silent_s;
  return since === null || since === undefined ? "" : ` for ${Math.round(since)} s`;
}

function leaseReason(s) {
  if (s.driver?.you) return null;
  if (!s.driver?.by) {
    const free = { ...say(s, "free"), action: TAKE };
    return drivesItself(s.script) ? { ...free, code: "itself", also: STOP_SCRIPT } : free;
  }
  const who = s.driver.device ? `${s.driver.by} (${s.driver.device})` : s.driver.by;
  if (s.driver.keeps) return askReason(s, who);
  if (s.driverIdleMs >= IDLE_MS) {
    return { ...say(s, "idle", { who }), action: TAKE };
  }
  return { ...say(s, "lease", { who }), action: OVER };
}

const RELOAD = /** @type {const} */ ({ label: "Reload", kind: "reload" });
const TAKE = /** @type {const} */ ({ label: "Take control", kind: "take" });
const OVER = /** @type {const} */ ({ label: "Hold to take over", kind: "take-over" });
export const STOP_SCRIPT = /** @type {const} */ ({ label: "Stop script", kind: "stop-script" });

/** The robot itself decides: who drives it is asked, and who rests does not keep it. */
function askReason(s, who) {
  const also = s.rights.includes("take") ? OVER : undefined;
  if (s.driver.asking) return { ...say(s, "asked", { who }), action: { label: "Do not ask", kind: "give-up" }, also };
  return { ...say(s, "kept", { who }), code: "lease", action: { label: "Ask for it", kind: "ask" }, also };
}

function momentReason(s) {
  if (s.loading) return say(s, "loading");
  if (s.dialog) return say(s, "dialog");
  if (s.script?.running && s.script.drives !== false && s.capabilities.drive?.arbitrates !== true) {
    return { ...say(s, "script", { script: scriptName(s.script) }), action: STOP_SCRIPT };
  }
  if (s.pictureAgeMs !== null && !(s.pictureAgeMs >= 0 && s.pictureAgeMs <= PICTURE_OLD_MS) && !s.inSight) return { ...oldPicture(s), code: "picture", action: SEE };
  if (s.roundTripMs >= LATE_MS) return say(s, "late", { by_ms: ` (${Math.round(s.roundTripMs)} ms)` });
  if (s.padFrozen) return say(s, "pad");
  if (s.fromKeys && !s.focus) return say(s, "focus");
  if (s.mustRelease) return released(s);
  return null;
}

/** What people call the script of a status. @param {Script} status @returns {string} */
export const scriptName = ({ label, file }) => String(label || file || "A script").slice(0, 40);

/** Whether a script moves the robot now, and no person. @param {Script|undefined} status @returns {boolean} */
export const drivesItself = (status) => status?.running === true && status.drives !== false && status.overridden !== true;

/** The server gives the same reason while a gesture that it has ended lasts. */
function released(s) {
  const { code, text } = say(s, "release");
  return { code, text: s.refusal && s.refusal !== text ? `${text}. It was: ${s.refusal}` : text };
}

const SEE = { label: "I can see the robot", kind: "see" };

function oldPicture(s) {
  if (s.pictureAgeMs < 0) return say(s, "picture-waits");
  if (Number.isNaN(s.pictureAgeMs)) return say(s, "picture-unknown");
  if (!Number.isFinite(s.pictureAgeMs)) return say(s, "picture-none");
  return say(s, "picture", { age: (s.pictureAgeMs / 1000).toFixed(1) });
}

/** A state in the server's words, of which WORDS in pebble/extensions/operator/client/drive_reasons.py has the table. @returns {Reason} */
function say(s, code, values = {}) {
  return { code, text: inWords(s.words, code, values) };
}

/** @param {Record<string, string>} words of the server @param {string} code @param {Record<string, any>} values @returns {string} */
export const inWords = (words, code, values) => (words[code] ?? code).replace(/{(\w+)}/g, (_, name) => values[name] ?? "");

export function reason(code, text) {
  return { code, text };
}

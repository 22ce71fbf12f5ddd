/** Why a control is off, in one line for people; the first reason counts. Pure. */

export const PING_TIMEOUT_MS = 1500;
export const PICTURE_OLD_MS = 2000;
const IDLE_MS = 5500; // the server lets a driver be replaced after 5 s without a gesture
export const SLOW_MS = 300; // from this round trip on, the speed is limited
const LATE_MS = 600;
export const SLOW_SPEED = 0.4;
const LET_GO = "Let go first"; // the server says the same
const RESET_MS = 600; // after a reset robots refuse a driver who has not paused for 0.5 s

/** @typedef {{code: string, text: string, action?: Action, also?: Action}} Reason */
/** @typedef {{label: string, kind: "take"|"ask"|"give-up"|"take-over"|"see"|"login"|"reload"|"stop-script"}} Action */

/**
 * @typedef {object} Situation
 * @property {string} name of the component
 * @property {boolean} open whether the control socket is
 * @property {boolean} [connecting] for the first time
 * @property {string} broker why the server cannot reach the broker; "" it can
 * @property {boolean} reload the page is older than the server
 * @property {boolean} drives false: not over this connection
 * @property {readonly string[]} rights
 * @property {boolean} loading what shows the picture and these reasons is not here yet
 * @property {boolean} hidden
 * @property {boolean} focus
 * @property {boolean} dialog whether one is open, or a panel
 * @property {boolean} fromKeys whether a key or the gamepad is used
 * @property {{online: boolean|null, silent_s: number|null}|undefined} liveness
 * @property {{latched: boolean, by: string}|undefined} estop
 * @property {number} freeForMs since it was seen stopped
 * @property {Record<string, any>} capabilities
 * @property {import("../messages.js").DriverView|undefined} driver
 * @property {number} driverIdleMs since the driver's last gesture; -1: it lasts, or is not known
 * @property {{running?: boolean, file?: string}|undefined} script
 * @property {number|null} pictureAgeMs null: no picture is wanted here; NaN: its age is not known; -1: none comes while it is driven
 * @property {boolean} inSight the driver sees the robot itself
 * @property {number} roundTripMs
 * @property {string} failed a part of this page that does not work; ""
 * @property {boolean} padFrozen
 * @property {boolean} mustRelease
 * @property {string} refusal why the server has ended the last gesture; "" it has not
 */

/** Why nothing may be commanded at all. @param {Situation} s @returns {Reason|null} */
export function offReason(s) {
  if (!s.open) return s.connecting ? reason("connecting", "Connecting to the server…") : reason("server", "No connection to the server");
  if (s.broker) return reason("broker", `The server cannot reach the broker: ${s.broker}`);
  return null;
}

/** Why this component cannot be driven now. @param {Situation} s @returns {Reason|null} */
export function driveReason(s) {
  return offReason(s) ?? pageReason(s) ?? robotReason(s) ?? leaseReason(s) ?? momentReason(s);
}

function pageReason(s) {
  if (s.failed) return reason("failed", `This page does not work (${s.failed}): load it again`, { label: "Reload", kind: "reload" });
  if (s.reload) return reason("reload", "This page is older than the server", { label: "Reload", kind: "reload" });
  if (!s.drives) return reason("plain", "Driving needs https: this connection is not encrypted");
  if (!s.rights.includes("drive")) return reason("role", "Log in as driver to drive", { label: "Log in", kind: "login" });
  if (s.hidden) return reason("hidden", "This page is in the background");
  return null;
}

function robotReason(s) {
  if (!s.liveness || s.liveness.online === false) return reason("silent", silence(s));
  if (s.estop?.latched) return reason("stopped", `Stopped by ${s.estop.by || "unknown"}`);
  if (s.freeForMs < RESET_MS) return reason("reset", "It was just reset: wait a moment");
  const drive = s.capabilities.drive;
  if (drive?.available !== true || drive.controls === false) return reason("no-drive", `${s.name} does not drive`);
  return null;
}

function silence(s) {
  const since = s.liveness?.silent_s;
  return since === null || since === undefined ? `${s.name} is offline` : `${s.name} is silent for ${Math.round(since)} s`;
}

function leaseReason(s) {
  if (s.driver?.you) return null;
  if (!s.driver?.by) {
    const runs = s.script?.running ? `${scriptName(s) || "A script"} runs. ` : "";
    return reason("free", `${runs}Take control to drive`, { label: "Take control", kind: "take" });
  }
  const who = s.driver.device ? `${s.driver.by} (${s.driver.device})` : s.driver.by;
  if (s.driver.keeps) return askReason(s, who);
  if (s.driverIdleMs >= IDLE_MS) {
    return reason("idle", `${who} has control, but does not drive`, { label: "Take control", kind: "take" });
  }
  return reason("lease", `${who} is driving`, OVER);
}

const OVER = /** @type {const} */ ({ label: "Hold to take over", kind: "take-over" });

/** The robot itself decides: who drives it is asked, and who rests does not keep it. */
function askReason({ driver, rights }, who) {
  const also = rights.includes("take") ? OVER : undefined;
  if (driver.asking) return { ...reason("asked", `${who} is asked for control`, { label: "Do not ask", kind: "give-up" }), also };
  return { ...reason("lease", `${who} has control`, { label: "Ask for it", kind: "ask" }), also };
}

function momentReason(s) {
  if (s.loading) return reason("loading", "This screen is still loading");
  if (s.dialog) return reason("dialog", "Close the panel first");
  if (s.script?.running && s.capabilities.drive?.arbitrates !== true) return scriptReason(scriptName(s));
  if (s.pictureAgeMs !== null && !(s.pictureAgeMs >= 0 && s.pictureAgeMs <= PICTURE_OLD_MS) && !s.inSight) return reason("picture", oldPicture(s), SEE);
  if (s.roundTripMs >= LATE_MS) return reason("late", `Commands are late (${Math.round(s.roundTripMs)} ms)`);
  if (s.padFrozen) return reason("pad", "The gamepad stands still: move its stick to neutral and back");
  if (s.fromKeys && !s.focus) return reason("focus", "Click this page first: keys go to another window");
  if (s.mustRelease) return reason("release", s.refusal && s.refusal !== LET_GO ? `${LET_GO}. It was: ${s.refusal}` : LET_GO);
  return null;
}

function scriptName(s) {
  const { file } = s.script;
  return typeof file === "string" ? file.slice(0, 40) : "";
}

function scriptReason(name) {
  const action = { label: `Stop ${name || "the script"}`, kind: "stop-script" };
  return reason("script", `${name || "A script"} is driving: stop it first`, action);
}

const SEE = { label: "I can see the robot", kind: "see" };

function oldPicture(s) {
  if (s.pictureAgeMs < 0) return "Pictures wait while you drive";
  if (Number.isNaN(s.pictureAgeMs)) return "How old this stream is, is not known";
  if (!Number.isFinite(s.pictureAgeMs)) return "There is no picture yet";
  return `The picture is ${(s.pictureAgeMs / 1000).toFixed(1)} s old`;
}

export function reason(code, text, action) {
  return action ? { code, text, action } : { code, text };
}

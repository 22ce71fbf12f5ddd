/** Where a component was, by its odometry: poses in metres, and the pieces of its trail. Pure. */

import { isObject } from "./json.js";

const PER_METRE = { mm: 1000, cm: 100, m: 1 };
const FARTHEST = 1e5; // metres: what is farther away is no position
const X = { x_mm: 1000, x_m: 1, x: 0 }; // name, and units per metre; 0: as the payload's unit says
const Y = { y_mm: 1000, y_m: 1, y: 0 };
const HEADING = { heading_rad: 1, theta_rad: 1, yaw_rad: 1, heading_deg: Math.PI / 180, yaw_deg: Math.PI / 180, heading: 1, theta: 1, yaw: 1 };

const STEP = 0.05; // metres, or
const TURN = 0.1; // radians, or
const REST_MS = 1000; // a pose nearer than that is not worth remembering
const FASTEST = 3; // metres per second: what is faster was no motion
const SLACK = 0.3; // metres, for poses that are rounded or late
const GAP_MS = 5000; // after that without a pose, the way between is not known

/**
 * A pose of wheel-odometry or localization-pose; fields differ by producer. ``run``: metres that it has travelled, which
 * fall only when the odometry begins anew; -1: unknown.
 * @typedef {{x: number, y: number, heading: number, run: number}} Pose
 */

/** @param {any} payload @returns {Pose | null} null: there is none in it */
export function poseOf(payload) {
  const value = isObject(payload?.value) ? payload.value : payload;
  if (!isObject(value)) return null;
  const unit = PER_METRE[[payload.unit, value.unit].find((one) => typeof one === "string")?.toLowerCase() ?? "mm"] ?? 1000;
  const x = length(value, X, unit);
  const y = length(value, Y, unit);
  if (x === null || y === null) return null;
  const name = Object.keys(HEADING).find((one) => Number.isFinite(value[one]));
  const distance = Number.isFinite(value.distance_mm) ? value.distance_mm / 1000 : -1;
  return { x, y, heading: name ? value[name] * HEADING[name] : 0, run: distance };
}

/** @param {any} pose of poseOf, or null @returns {string} */
export function poseWords(pose) {
  if (!pose) return "No position was received yet.";
  const rounded = (value, digits) => (Number(value.toFixed(digits)) || 0).toFixed(digits); // without the sign of zero
  return `x ${rounded(pose.x, 2)} m · y ${rounded(pose.y, 2)} m · heading ${rounded((pose.heading * 180) / Math.PI, 0)}°`;
}

function length(value, names, unit) {
  const name = Object.keys(names).find((one) => Number.isFinite(value[one]));
  const metres = name ? value[name] / (names[name] || unit) : NaN;
  return Math.abs(metres) <= FARTHEST ? metres : null;
}

/** Whether a pose is worth remembering, so long after another one. @param {any} pose @param {any} last @param {number} ms */
export function differs(pose, last, ms) {
  if (ms >= REST_MS || pose.run < last.run) return true;
  const turned = Math.abs(Math.atan2(Math.sin(pose.heading - last.heading), Math.cos(pose.heading - last.heading)));
  return Math.hypot(pose.x - last.x, pose.y - last.y) >= STEP || turned >= TURN;
}

/**
 * The poses in pieces: after a jump, a restart of the odometry or a long silence a new one begins.
 * @param {number[]} times ms @param {any[]} poses @returns {Pose[][]}
 */
export function pieces(times, poses) {
  /** @type {Pose[][]} */
  const found = [];
  poses.forEach((pose, index) => {
    const before = poses[index - 1];
    if (!before || breaks(pose, before, times[index] - times[index - 1])) found.push([]);
    found[found.length - 1].push(pose);
  });
  return found;
}

function breaks(pose, before, ms) {
  if (ms > GAP_MS || (pose.run >= 0 && pose.run < before.run)) return true;
  return Math.hypot(pose.x - before.x, pose.y - before.y) > SLACK + (FASTEST * ms) / 1000;
}

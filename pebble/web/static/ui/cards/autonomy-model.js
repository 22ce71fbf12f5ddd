// Which script of a robot runs, since when, and why none can be started. Robots may report anything.

import { nameIn } from "../parts/looks.js";
import { sectionOf, whyNotMoved } from "../parts/why-not.js";
import { inner, isObject } from "../parts/words.js";

const MOST_DEPENDENCIES = 16;

/**
 * @typedef {{running: boolean, file: string, waits: boolean, error: string, pid: unknown,
 *   dependencies: {file: string, running: boolean}[], config: [string, unknown][]}} Status
 */

/** @param {unknown} payload of autonomy-status @returns {Status} */
export function statusOf(payload) {
  const value = inner(payload);
  const status = isObject(value) ? value : {};
  const text = (one) => (typeof one === "string" ? one : "");
  const parts = Array.isArray(status.dependencies) ? status.dependencies.filter(isObject) : [];
  const running = status.running === true;
  return {
    running,
    file: text(status.file) || (running ? "A script" : ""),
    waits: status.overridden === true,
    error: text(status.error),
    pid: status.pid,
    dependencies: parts
      .slice(0, MOST_DEPENDENCIES)
      .map((one) => ({ file: text(one.file) || "?", running: one.running === true })),
    config: isObject(status.config) ? Object.entries(status.config).slice(0, 64) : [],
  };
}

/** When the script of one robot was first seen running; robots report only that it runs. */
export class Since {
  constructor() {
    /** @type {string | undefined} */
    this.run = undefined;
    this.at = 0;
    this.isExact = false;
  }

  /** @param {Status} status @param {number} receivedAt epoch ms @returns {Since} */
  update({ running, file, pid }, receivedAt) {
    const run = running ? JSON.stringify([file, pid]) : "";
    if (run !== this.run) {
      this.isExact = this.run !== undefined; // what ran when the page came may have begun at any time
      this.at = receivedAt;
      this.run = run;
    }
    return this;
  }
}

/**
 * Who moves the robot by hand now, and whether scripts give way there: then one may be started, and waits.
 * @param {any} page its services @param {string} ref @returns {{by: string, waits: boolean}} by "bob is"; "" nobody
 */
export function handDriven({ store }, ref) {
  const driver = store.get(ref, "web/driver")?.value;
  const moves = driver?.by && driver.idle_s === null;
  const waits = sectionOf(store.get(ref, "capabilities")?.value, "drive").arbitrates === true;
  return { by: moves ? (driver.you ? "You are" : `${driver.by} is`) : "", waits };
}

/** @param {any} page its services @param {string} ref @returns {string} why no script can be started; "" one can */
export function whyNotStarted(page, ref) {
  const why = whyNotMoved(page, ref, "autonomy");
  if (why) return why;
  if (page.store.get(ref, "web/liveness")?.value.online !== true) return `${nameIn(page.store, ref)} has not been seen yet`;
  const stop = page.store.get(ref, "web/estop")?.value;
  if (stop?.latched) return `Stopped by ${stop.by || "unknown"}`;
  const { by, waits } = handDriven(page, ref);
  return by && !waits ? `${by} driving` : "";
}

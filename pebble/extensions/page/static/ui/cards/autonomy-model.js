// Why no script of a robot can be started.

import { nameIn } from "../parts/looks.js";
import { sectionOf, whyNotMoved } from "../parts/why-not.js";

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

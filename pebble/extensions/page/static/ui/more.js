// What is not needed at once: actions of keys and gamepad besides driving, the screen that stays on, and wall screens.

import { ROOT } from "../core/browser.js";
import * as more from "../core/browser-more.js";
import { Actions } from "../core/actions.js";
import { Pads } from "../core/pads.js";
import { install as installCommands } from "./commands.js";
import { lacks } from "./parts/lacks.js";
import { WATCHES } from "./parts/models.js";

const WATCHING = ["help", "mute"]; // what can be asked of a screen that only watches
const STEP = 0.1; // of the speed, for each press
const SLOWEST = 0.05; // as the slider's
const CHECK_MS = 1000;
const IDLE_MS = 55_000; // the server ends what is not used for a minute
const RESTED_MS = 5000; // from then on control is given to who asks for it
const RELOAD_MS = 5000; // where no person is there to press a button

/** To be called once. @param {any} page */
export function install(page) {
  const { driver } = page;
  driver.onAction = (id, phase) => act(page, id, phase);
  driver.actions = new Actions(
    (id, phase) => driver.onAction(id, phase),
    () => driver.ref !== "" && document.querySelector("dialog[open]") === null,
  );
  installCommands(page);
  driver.lease.onLost = (by, idleMs) => page.connection.show(controlEnd(by, idleMs));
  driver.onChange(() => driver.gestureActive && page.settings.begin("drive"));
  driver.pads = new Pads(driver);
  new Wall(page).start();
  const missing = lacks().join(" ");
  if (missing) page.connection.show(missing);
}

/** @param {string} by who has it now @param {number} idleMs since this page drove */
function controlEnd(by, idleMs) {
  const why = idleMs > IDLE_MS ? "after a minute without driving" : "with the connection";
  if (!by) return `Your control has ended ${why}: take it again`;
  return idleMs < RESTED_MS ? `${by} took over` : `${by} has control now: you had rested`;
}

/** Do what an action means. What other modules do is fetched with the first press. @param {any} page @param {string} id @param {"down" | "up"} phase */
function act(page, id, phase) {
  const { ref } = page.driver;
  if (phase === "down" && WATCHES && !WATCHING.includes(id)) return undefined;
  switch (id) {
    case "help":
      return page.panels.toggle("help");
    case "faster":
      return changeSpeed(page.driver, STEP);
    case "slower":
      return changeSpeed(page.driver, -STEP);
    case "flash":
      return say(page, import("./cards/lights-model.js").then((lights) => lights.toggleFlash(page, ref)));
    case "repeat":
      return say(page, import("./cards/sounds-model.js").then((sounds) => sounds.repeatLast(page, ref)));
    case "mute":
      return page.sound?.toggleMute();
    case "talk":
      return page.sound?.talk(phase === "down");
  }
}

function changeSpeed(driver, step) {
  const speed = Math.round(100 * (driver.sliders.speed + step)) / 100;
  driver.sliders.speed = Math.min(1, Math.max(SLOWEST, speed));
  driver.changed();
}

/** @param {any} page @param {Promise<string>} answer why it was not done; "" it was */
async function say(page, answer) {
  const why = await answer.catch((error) => error.message);
  if (why) page.connection.show(`Not done: ${why}`);
}

/** A screen that is not touched for days. */
class Wall {
  constructor(page) {
    this.page = page;
    /** @type {WakeLockSentinel | null} */
    this.lock = null;
    this.uselessSince = Infinity;
  }

  start() {
    setInterval(() => this.check(), CHECK_MS);
    document.addEventListener("visibilitychange", () => this.check());
  }

  check() {
    const { connection, driver, store } = this.page;
    const drives = connection.isOpen && store.get(driver.ref, "web/driver")?.value.you === true;
    this.keepAwake(WATCHES || drives);
    if (WATCHES) this.recover(connection);
  }

  /** Browsers allow it over https; they take the lock away when the page is hidden. */
  async keepAwake(wanted) {
    if (wanted === (this.lock?.released === false) || document.hidden) return;
    if (!wanted) this.lock?.release();
    this.lock = wanted ? ((await more.wakeLock()?.request("screen").catch(() => null)) ?? null) : null;
  }

  /** Load the page again when it is older than the server, or the server has ended its session. */
  recover({ bye, isOld }) {
    if (!bye && !isOld) this.uselessSince = Infinity;
    else if (this.uselessSince === Infinity) this.uselessSince = performance.now();
    else if (performance.now() - this.uselessSince > RELOAD_MS) this.reload();
  }

  /** Without an answer the browser would show a page of its own, and stay there. */
  async reload() {
    this.uselessSince = performance.now(); // of the next attempt
    const answer = await fetch(`${ROOT}healthz`, { cache: "no-store" }).catch(() => null);
    if (answer?.ok) location.reload();
  }
}

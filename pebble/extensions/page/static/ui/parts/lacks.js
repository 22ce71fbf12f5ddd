// What people would miss in this browser, said once when the page is opened, and in the settings.

import * as browser from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { WATCHES } from "./models.js";

/** @returns {string[]} sentences */
export function lacks() {
  const kept = browser.local.set("pebble lacks", "") && browser.session.set("pebble lacks", "");
  const dark = !more.wakeLock() && (WATCHES || browser.media("(pointer: coarse)").matches);
  return [
    !kept && "This browser remembers nothing for this page: settings, and your control, are lost when it is loaded again.",
    !browser.gamepads() && "This browser shows no gamepads to this page: they neither drive nor stop.",
    dark && "This browser cannot keep the screen on.",
  ].filter((one) => typeof one === "string");
}

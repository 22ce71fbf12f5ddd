/** Presses of Escape, also those of which the browser shows no key: it leaves full screen by them, or closes a list. */

import * as browser from "./browser.js";

const TWICE_MS = 600;

export class Escapes {
  /** @param {() => void} onTwice */
  constructor(onTwice) {
    this.onTwice = onTwice;
    this.pressedAt = -Infinity;
    this.isFull = true; // as far as it was told
    /** @type {{value: string} | null} */
    this.list = null; // that is open
    this.value = ""; // as it was when it was opened
  }

  /** ``now``: when the key went down, also if it is handled much later. */
  press(now = performance.now()) {
    if (now - this.pressedAt < TWICE_MS) this.onTwice();
    this.pressedAt = now;
  }

  /** To be called when full screen has begun or ended. WebKit says twice that it ended if that came with its begin. */
  fullScreenChanged() {
    const { on, left } = browser.fullScreen;
    if (this.isFull && !on && !left) this.press();
    this.isFull = on;
  }

  /** To be called every 50 ms: nothing tells that a list has closed. */
  look() {
    const list = browser.openList();
    if (list === this.list) return;
    if (this.list && this.list.value === this.value) this.press();
    this.list = list;
    this.value = list?.value;
  }
}

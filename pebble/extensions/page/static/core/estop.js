/** The emergency stop: sent on the control socket, and also by a request if that is not open. */

import * as browser from "./browser.js";

export class Estop {
  /** @param {{send: (op: Record<string, any>) => boolean, you?: any}} socket */
  constructor(socket) {
    this.socket = socket;
    /** @type {{ref: string, stop: string, at: number, reached: boolean}|null} */
    this.pressed = null; // the newest press of this page
    /** @type {() => void} */
    this.onChange = () => {};
  }

  /** Stop one component, or all if ``ref`` is "". @param {string} ref @param {string} why */
  press(ref, why = "button") {
    const op = { op: "estop", ref, stop: browser.randomHex(8), why };
    this.pressed = { ref, stop: op.stop, at: Date.now(), reached: true };
    if (!this.socket.send(op)) this.post(op, this.pressed);
    this.onChange();
  }

  /** Send this stop no more. @param {string} stop */
  end(stop) {
    this.socket.send({ op: "estop-end", stop });
  }

  /** End the stops of these owners, as they were shown. @param {string} ref @param {any[]} owners */
  reset(ref, owners) {
    const shown = owners.filter((one) => one.latched).map(({ owner, boot, count }) => ({ owner, boot, count }));
    return this.socket.send({ op: "estop-reset", ref, owners: shown });
  }

  async post(op, pressed) {
    pressed.reached = false;
    try {
      const headers = { "content-type": "application/json" };
      const url = `${browser.ROOT}api/estop?name=${encodeURIComponent(this.socket.you?.user ?? "")}`;
      const answer = await fetch(url, { method: "POST", headers, body: JSON.stringify(op), keepalive: true });
      pressed.reached = answer.ok;
    } catch {
      pressed.reached = false;
    }
    this.onChange();
  }
}

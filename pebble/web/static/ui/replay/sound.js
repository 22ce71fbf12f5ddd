// The sound of a recording: as a live robot's, but the server's player sends it by another socket.

import { Sound } from "../robot/sound-model.js";

export class ReplaySound extends Sound {
  /** @param {any} page the services of the replay @param {string} ref */
  constructor({ store, connection }, ref) {
    super({ store, connection, route: { ref, onChange() {} } });
  }

  /** The worker opens no socket of its own. @param {string} _ref @param {MessagePort | null} port */
  connect(_ref, port) {
    super.connect("", port);
  }

  /** @param {Uint8Array} payload */
  feed(payload) {
    if (this.listening) this.worker?.postMessage({ op: "take", payload: payload.slice().buffer });
  }

  /** A seek: what waits at the loudspeaker is not played. */
  async begin() {
    if (!this.worker || !this.speaker) return;
    const { attach } = await this.speaker;
    if (!this.listening) return;
    const { port1, port2 } = new MessageChannel();
    attach(port2);
    this.connect("", port1);
  }

  talkReason() {
    return "This is a recording";
  }
}

// The pictures of a recording: as live ones, but the server's player sends them by another socket.

import { Pictures } from "../pictures.js";

const HEAD_BYTES = 5; // u32 number, u8 kind: as the messages of the server
const MOST_PENDING = 60; // pictures at the worker

export class ReplayPictures extends Pictures {
  /** @param {(bitmap: ImageBitmap, info: any) => void} draw as that of Pictures, with ``receivedMs`` @param {() => void} onChange */
  constructor(draw, onChange) {
    super((bitmap, info) => draw(bitmap, { ...info, receivedMs: this.pending.get(info.seq) }), onChange);
    /** @type {Map<number, number>} when the pictures that are at the worker were received, by number */
    this.pending = new Map();
    this.number = 0;
    this.behind = false;
  }

  /** A seek: nothing of before is drawn, or built on. */
  begin() {
    this.connection++;
    this.pending.clear();
    this.behind = false;
    this.change({ waiting: false, problem: "" });
  }

  /** @param {Uint8Array} payload @param {number} receivedMs @param {boolean} shown */
  feed(payload, receivedMs, shown) {
    this.behind = this.pending.size >= (this.behind ? 1 : MOST_PENDING);
    if (this.behind) return this.change({ problem: "Pictures are left out: this browser is too slow for this speed" });
    const number = ++this.number >>> 0;
    const message = new Uint8Array(HEAD_BYTES + payload.length);
    new DataView(message.buffer).setUint32(0, number);
    message.set(payload, HEAD_BYTES);
    this.pending.set(number, receivedMs);
    this.worker ??= this.startWorker();
    this.worker?.postMessage({ connection: this.connection, message: message.buffer, quiet: !shown }, [message.buffer]);
  }

  startWorker() {
    return super.startWorker(new URL("./video-worker.js", import.meta.url));
  }

  /** @param {any} made of the worker */
  take(made) {
    super.take(made);
    if (made.connection === this.connection) this.pending.delete(made.seq);
  }

  /** The server's player asks for no answers. */
  acknowledge() {}
}

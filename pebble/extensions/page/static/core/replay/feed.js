/** The socket of a replay: what the server's player sends, where it is, and what it is asked for. No DOM. */

import * as browser from "../browser.js";

export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];

const HEAD_BYTES = 9; // u8 what it is, f64 when it was received
const SOUND = 2; // 0: a picture that only later ones need, 1: a picture
const RETRY_MS = 1000;
const AHEAD_MS = 1000; // so long the time goes on without a word of the server
const SKIP_SHOWN_MS = 6000;

/**
 * @typedef {object} Parts
 * @property {() => void} begin what was sent before is void: a seek has arrived
 * @property {(message: any) => void} take a state, or lines of the log
 * @property {(payload: Uint8Array, receivedMs: number, shown: boolean) => void} picture
 * @property {(payload: Uint8Array) => void} sound
 * @property {() => void} changed
 * @property {() => number} [clock] ms, monotonic
 * @property {(path: string) => WebSocket | null} [open]
 */

export class Feed {
  /** @param {string} ref @param {Parts} parts */
  constructor(ref, parts) {
    this.ref = ref;
    this.parts = { clock: () => performance.now(), open: browser.webSocket, ...parts };
    /** @type {WebSocket | null} */
    this.socket = null;
    this.played = { at: 0, on: false, speed: 1, ended: false }; // as the server says
    this.heardAt = 0; // of the clock
    this.sought = NaN; // where the server was asked to go, and is not yet
    this.wanted = NaN; // the newest seek; it is sent once the one before has arrived
    this.soughtAt = 0; // of the clock
    this.seeks = 0; // that have arrived
    /** @type {{since: number, until: number, at: number} | null} the last stretch that was left out; ``at``: of the clock */
    this.skipped = null;
    this.problem = ""; // why nothing comes
    this.retry = 0;
  }

  get seeking() {
    return !Number.isNaN(this.wanted);
  }

  /** Epoch ms of the recording. */
  get position() {
    if (this.seeking) return this.wanted;
    const { at, on, speed } = this.played;
    return at + (on ? Math.min(AHEAD_MS, this.parts.clock() - this.heardAt) * speed : 0);
  }

  /** @param {number} ms epoch */
  seek(ms) {
    const idle = !this.seeking;
    this.wanted = Math.max(0, ms);
    this.skipped = null;
    if (idle) this.go();
    this.parts.changed();
  }

  /** @param {boolean} on */
  play(on) {
    this.send({ op: "play", on });
  }

  /** @param {number} speed one of SPEEDS */
  setSpeed(speed) {
    if (SPEEDS.includes(speed)) this.send({ op: "speed", speed });
  }

  close() {
    clearTimeout(this.retry);
    const { socket } = this;
    this.socket = null;
    socket?.close();
  }

  send(op) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(op));
  }

  go() {
    this.sought = this.wanted;
    this.soughtAt = this.parts.clock();
    if (this.socket) this.send({ op: "seek", at: this.sought });
    else this.connect();
  }

  connect() {
    clearTimeout(this.retry);
    const query = new URLSearchParams({ robot: this.ref, at: String(this.position) });
    const { on, speed } = this.played;
    this.sought = this.wanted = this.position;
    this.problem = "";
    const socket = this.parts.open(`ws/replay?${query}`);
    if (!socket) return this.lost(socket);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (this.sought !== this.wanted) this.go(); // another place meanwhile
      if (speed !== 1) this.setSpeed(speed);
      if (on) this.play(true);
    };
    socket.onmessage = ({ data }) => socket === this.socket && this.read(data);
    socket.onclose = () => this.lost(socket);
  }

  /** @param {WebSocket | null} socket */
  lost(socket) {
    if (socket !== this.socket) return;
    this.socket = null;
    if (!this.problem) this.retry = setTimeout(() => this.connect(), RETRY_MS);
    this.parts.changed();
  }

  /** @param {string | ArrayBuffer} data */
  read(data) {
    if (typeof data === "string") return this.take(JSON.parse(data));
    if (!Number.isNaN(this.sought)) return; // it is of before the seek
    const head = new DataView(data);
    const payload = new Uint8Array(data, HEAD_BYTES);
    const what = head.getUint8(0);
    if (what === SOUND) this.parts.sound(payload);
    else this.parts.picture(payload, head.getFloat64(1), what === 1);
  }

  take(message) {
    if (message.op === "bye") {
      this.problem ||= message.why; // the first one says most
      return this.parts.changed();
    }
    const arrives = message.op === "played" && message.begins && Math.abs(message.at - this.sought) < 1;
    if (!Number.isNaN(this.sought) && !arrives) return;
    this.heardAt = this.parts.clock();
    if (message.op === "played") return this.follow(message, arrives);
    this.played.at = message.now ?? this.position;
    this.parts.take(message);
  }

  follow({ at, on, speed, ended, skipped }, arrives) {
    this.played = { at, on, speed, ended };
    if (skipped) this.skipped = { since: skipped[0], until: skipped[1], at: this.heardAt };
    else if (this.skipped && this.heardAt - this.skipped.at > SKIP_SHOWN_MS) this.skipped = null;
    if (arrives) this.arrive();
    this.parts.changed();
  }

  arrive() {
    const other = this.wanted !== this.sought;
    this.sought = NaN;
    if (other) return this.go();
    this.wanted = NaN;
    this.seeks++;
    this.parts.begin();
  }
}

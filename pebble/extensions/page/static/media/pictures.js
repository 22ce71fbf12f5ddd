// The pictures of one robot on a page: a socket to the server, and a worker that decodes.

import * as browser from "../core/browser.js";

const DRAWN = 0;
const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 4000;
const CODECS = ["avc1.42E01E", "avc1.640028"]; // baseline and high profile

/**
 * @typedef {object} Info about a picture
 * @property {number} seq
 * @property {string} encoding json | pbvd | pbvz | h264 | jpeg
 * @property {number|null} capturedMs epoch time at the robot, by its clock
 * @property {number|null} frame
 * @property {number} width
 * @property {number} height
 * @property {boolean} key
 * @property {boolean} rescue made by the server, because this page cannot decode or is too slow
 */

/**
 * @typedef {object} State
 * @property {string} ref the component whose pictures are shown; "" is none
 * @property {"off"|"connecting"|"open"|"lost"} connection to the server
 * @property {boolean} waiting for a key frame
 * @property {boolean} rescue
 * @property {string} encoding of the last picture
 * @property {string} problem why the last picture was not drawn
 */

/** Shows the pictures of one component at a time. */
export class Pictures {
  /**
   * @param {(bitmap: ImageBitmap, info: Info) => void} canvasDraw draws at once; the bitmap is closed afterwards
   * @param {(state: State) => void} onChange called when the state has changed, not for each picture
   */
  constructor(canvasDraw, onChange) {
    this.canvasDraw = canvasDraw;
    this.onChange = onChange;
    /** @type {State} */
    this.state = { ref: "", connection: "off", waiting: false, rescue: false, encoding: "", problem: "" };
    /** @type {WebSocket|null} */
    this.socket = null;
    /** @type {Worker|null} */
    this.worker = null;
    this.connection = 0; // numbers connections: what is left of an earlier one is not drawn
    this.wait = FIRST_WAIT_MS;
    this.timer = 0;
  }

  /** Which encodings this browser decodes. Tested, never guessed from its name. */
  static async canDecode() {
    const can = [];
    if (await decodesH264()) can.push("h264");
    if (browser.find("createImageBitmap") && browser.find("DecompressionStream")) {
      if (readsBack()) can.push("pbvd", "json");
      can.push("jpeg");
    }
    return can;
  }

  /** Show the pictures of this component from now on. @param {string} ref */
  show(ref) {
    if (ref === this.state.ref) return;
    this.disconnect();
    this.change({ ref, connection: "connecting", waiting: false, rescue: false, encoding: "", problem: "" });
    this.wait = FIRST_WAIT_MS;
    this.connect();
  }

  stop() {
    this.disconnect();
    this.worker?.terminate();
    this.worker = null;
    this.change({ ref: "", connection: "off", waiting: false, rescue: false, encoding: "", problem: "" });
  }

  async connect() {
    const connection = ++this.connection;
    const can = await Pictures.canDecode();
    if (connection !== this.connection) return; // stopped meanwhile
    this.worker ??= this.startWorker();
    const query = new URLSearchParams({ ref: this.state.ref, can: can.join(",") });
    const socket = browser.webSocket(`ws/media?${query}`);
    if (!socket) return this.lost();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.change({ connection: "open" });
    socket.onmessage = ({ data }) => {
      this.worker?.postMessage({ connection, message: data }, [data]);
    };
    socket.onclose = () => {
      if (connection === this.connection) this.lost();
    };
    this.socket = socket;
  }

  disconnect() {
    clearTimeout(this.timer);
    this.connection++;
    this.socket?.close();
    this.socket = null;
  }

  lost() {
    this.socket = null;
    this.change({ connection: "lost" });
    this.timer = setTimeout(() => this.connect(), this.wait * (0.75 + 0.5 * Math.random()));
    this.wait = Math.min(LONGEST_WAIT_MS, 2 * this.wait);
  }

  /** @param {URL} [url] of the worker */
  startWorker(url = new URL("./video-worker.js", import.meta.url)) {
    const fail = ({ message = "a part of this page is missing" }) =>
      this.change({ problem: `Pictures cannot be decoded here: ${message}` });
    try {
      const worker = browser.worker(url);
      worker.onmessage = ({ data }) => this.take(data);
      worker.onerror = (event) => {
        fail(event);
        if (event.message || worker !== this.worker) return;
        this.worker = null; // it could not be fetched: the next connection has another one
        this.socket?.close();
      };
      return worker;
    } catch (error) {
      fail(error);
      return null;
    }
  }

  /** Draw what the worker has made, and only then acknowledge it. @param {any} made */
  take(made) {
    const { bitmap } = made;
    const current = made.connection === this.connection;
    this.wait = FIRST_WAIT_MS;
    try {
      if (current && bitmap) this.draw(bitmap, made);
      else if (current) this.change({ waiting: made.what !== DRAWN, problem: made.problem });
    } finally {
      bitmap?.close();
      if (current) this.acknowledge(made.seq, made.what);
    }
  }

  /** @param {ImageBitmap} bitmap @param {any} made */
  draw(bitmap, { seq, encoding, capturedMs, frame, key, rescue }) {
    const { width, height } = bitmap;
    this.change({ waiting: false, rescue, encoding, problem: "" });
    this.canvasDraw(bitmap, { seq, encoding, capturedMs, frame, width, height, key, rescue });
  }

  /** @param {number} seq @param {number} what */
  acknowledge(seq, what) {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const answer = new DataView(new ArrayBuffer(5));
    answer.setUint32(0, seq);
    answer.setUint8(4, what);
    this.socket.send(answer.buffer);
  }

  /** @param {Partial<State>} changes */
  change(changes) {
    const state = { ...this.state, ...changes };
    const same = Object.entries(state).every(([key, value]) => /** @type {any} */ (this.state)[key] === value);
    this.state = state;
    if (!same) this.onChange(state);
  }
}

async function decodesH264() {
  if (!browser.find("VideoDecoder")) return false; // plain http from another machine, for example
  try {
    const answers = await Promise.all(CODECS.map((codec) => browser.find("VideoDecoder").isConfigSupported({ codec })));
    return answers.every(({ supported }) => supported);
  } catch {
    return false;
  }
}

/** Whether pixels that were drawn are read back as they were: some browsers add noise against tracking. */
function readsBack() {
  if (!browser.find("OffscreenCanvas")) return false;
  const context = new (browser.find("OffscreenCanvas"))(16, 16).getContext("2d", { willReadFrequently: true });
  if (!context) return false;
  const pixels = context.createImageData(16, 16);
  for (let i = 0; i < pixels.data.length; i++) pixels.data[i] = i % 4 === 3 ? 255 : (i * 37) % 256;
  context.putImageData(pixels, 0, 0);
  const { data } = context.getImageData(0, 0, 16, 16);
  return data.every((value, index) => value === pixels.data[index]);
}

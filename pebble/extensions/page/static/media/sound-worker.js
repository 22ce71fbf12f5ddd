// The sound of one component: its socket, what is played of it, and what a person says to it.

import * as browser from "../core/browser.js";
import { decodesOpus } from "./opus.js";
import { Playout } from "./playout.js";
import { Uplink } from "./uplink.js";

const [RECEIVED, , END] = [0, 1, 2]; // what is sent; 1 is a piece of the voice
const ACKNOWLEDGED = 4; // packets at a time
const STATS_MS = 250;
const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 4000;
const LATE_BYTES = 10_000; // 0.3 s of the voice that could not be sent: what comes then is left out
const ALIVE_MS = 1000; // without a message of the page, which may stand still while a key was released

let ref = "";
let can = "";
let name = "";
let device = "";
/** @type {WebSocket|null} */
let socket = null;
let wait = FIRST_WAIT_MS;
/** @type {Playout|null} */
let playout = null;
/** @type {Uplink|null} */
let uplink = null;
let received = 0; // on this connection
let aliveAt = 0;

self.onmessage = ({ data }) => {
  aliveAt = performance.now();
  if (data.op === "open") open(data);
  else if (data.op === "take") playout?.take(data.payload);
  else if (data.op === "talk") talk(data);
  else if (data.op === "end") end();
};

/**
 * ``ref`` "": packets come by messages; ``port`` null: this page only talks; ``name`` and ``device``: whose it is
 * @param {{ref: string, port: MessagePort|null, rate: number, name: string, device: string}} message
 */
async function open(message) {
  ({ ref, name, device } = message);
  if (message.port) {
    playout = new Playout(message.port, message.rate);
    can = (await decodesOpus()) ? "opus,pcm" : "pcm";
    setInterval(() => self.postMessage({ stats: playout?.stats() }), STATS_MS);
  }
  if (ref) connect();
  else self.postMessage({ connection: "open" });
}

function connect() {
  const mine = browser.webSocket(`ws/sound?${new URLSearchParams({ ref, can, name, device })}`);
  if (!mine) return lost();
  mine.binaryType = "arraybuffer";
  received = 0;
  mine.onopen = () => self.postMessage({ connection: "open" });
  mine.onmessage = ({ data }) => {
    wait = FIRST_WAIT_MS;
    if (typeof data === "string") self.postMessage({ answer: JSON.parse(data) });
    else take(data);
  };
  mine.onclose = lost;
  socket = mine;
}

function lost() {
  uplink?.close();
  uplink = null; // it cannot go on by another connection
  self.postMessage({ connection: "lost" });
  setTimeout(connect, wait * (0.75 + 0.5 * Math.random()));
  wait = Math.min(LONGEST_WAIT_MS, 2 * wait);
}

/** @param {ArrayBuffer} payload */
function take(payload) {
  playout?.take(payload);
  if (++received % ACKNOWLEDGED === 0) send(head(RECEIVED, received));
}

/** @param {{talk: number, port: MessagePort, rate: number}} message */
function talk(message) {
  uplink?.close();
  uplink = new Uplink(message.port, message.rate, message.talk, (piece) => {
    if (performance.now() - aliveAt > ALIVE_MS) giveUp();
    else if ((socket?.bufferedAmount ?? 0) < LATE_BYTES) send(piece);
  });
}

/** The page stands still: perhaps a key was released. */
function giveUp() {
  if (!uplink) return;
  const answer = { talk: uplink.talk, on: false, why: "The page stood still: talk again" };
  self.postMessage({ answer });
  end();
}

function end() {
  if (uplink) send(head(END, uplink.talk));
  uplink?.close();
  uplink = null;
}

/** @param {number} what @param {number} number */
function head(what, number) {
  const message = new DataView(new ArrayBuffer(5));
  message.setUint8(0, what);
  message.setUint32(1, number);
  return message.buffer;
}

/** @param {ArrayBuffer} message */
function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(message);
}

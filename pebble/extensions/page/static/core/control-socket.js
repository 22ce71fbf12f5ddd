/** The control socket: commands to the server, state from it; made anew whenever it is lost. */

import * as browser from "./browser.js";
import { PING_TIMEOUT_MS } from "./reasons.js";

const FIRST_DELAY_MS = 250;
const LONGEST_DELAY_MS = 4000;
const CHECK_MS = 250;
const CONNECT_MS = 8000; // a phone far from its access point needs seconds for TCP, TLS and the handshake
const STATES = ["welcome", "state", "ping"];
const TOKEN = "pebble-token"; // restores the driver lease after a reload

/** @typedef {{store: any, version: string, name?: () => string, onOpen?: () => void, onLost?: () => void,
 *   onRefused?: (message: any) => void, onDone?: (message: any) => void, onLogs?: (message: any) => void,
 *   onBye?: (message: any) => void, maySend?: (op: string) => boolean,
 *   onChange?: () => void}} Options */

export class ControlSocket {
  /** @param {Options} options */
  constructor(options) {
    this.options = options;
    /** @type {"connecting"|"open"|"lost"} */
    this.state = "connecting";
    /** @type {any} */
    this.you = null; // the server's welcome
    this.roundTripMs = -1;
    this.lostAt = 0; // Date.now()
    this.attempts = 0;
    this.again = true;
    /** @type {WebSocket|null} */
    this.socket = null;
    this.heardAt = 0;
    /** @type {ReturnType<typeof setTimeout>|undefined} */
    this.retry = undefined;
    this.outdated = false; // what the store has is of an earlier connection
    setInterval(() => this.check(), CHECK_MS);
  }

  connect() {
    const socket = browser.webSocket("ws/control");
    if (!socket) return this.lost(0);
    this.socket = socket;
    this.heardAt = performance.now();
    socket.onopen = () => this.hello(socket);
    socket.onmessage = (event) => socket === this.socket && this.read(event.data);
    socket.onclose = (event) => socket === this.socket && this.lost(event.code);
  }

  /** @param {Record<string, any>} op @returns {boolean} whether it was sent */
  send(op) {
    if (this.state !== "open" || this.socket?.readyState !== WebSocket.OPEN) return false;
    if (!this.maySend(op.op)) return false;
    this.socket.send(JSON.stringify(op));
    return true;
  }

  maySend(op) {
    return this.options.maySend?.(op) ?? true;
  }

  /** Give the connection up, and make a new one: its clock is not to be trusted any more. */
  restart() {
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.lost(0);
  }

  hello(socket) {
    const token = (this.maySend("lease") && browser.session.get(TOKEN)) || "";
    const { version, name } = this.options;
    socket.send(JSON.stringify({ op: "hello", version, device: device(), name: name?.() ?? "", token }));
  }

  /** A state that was not taken whole would look like the newest one: a new connection brings all of it. */
  read(text) {
    const message = JSON.parse(text);
    try {
      this.receive(message);
    } catch (error) {
      if (STATES.includes(message.op)) this.restart();
      throw error;
    }
  }

  receive(message) {
    this.heardAt = performance.now();
    switch (message.op) {
      case "ping":
        this.socket?.send(JSON.stringify({ op: "echo", n: message.n, t: performance.now() }));
        this.roundTripMs = message.round_trip_ms;
        this.attempts = 0;
        this.options.store.sync(message.now, message.round_trip_ms);
        return this.options.onChange?.();
      case "state":
        return this.take(message);
      case "welcome":
        return this.welcome(message);
      case "refused":
        return this.options.onRefused?.(message);
      case "done":
        return this.options.onDone?.(message);
      case "logs":
        return this.options.onLogs?.(message);
      case "bye":
        this.again = message.again;
        return this.options.onBye?.(message);
    }
  }

  welcome(message) {
    browser.session.set(TOKEN, message.token);
    this.you = message;
    this.state = "open";
    this.outdated = true;
    this.options.store.sync(message.now);
    this.options.onOpen?.();
    this.options.onChange?.();
  }

  take(message) {
    if (this.outdated) this.options.store.clear(); // the first state of a connection has all that there is
    this.outdated = false;
    for (const ref of message.gone ?? []) this.options.store.remove(ref);
    for (const [ref, metric, value, age] of message.set) {
      if (value === null) this.options.store.drop(ref, metric);
      else this.options.store.set(ref, metric, value, age);
    }
  }

  check() {
    const limit = this.state === "open" ? PING_TIMEOUT_MS : CONNECT_MS;
    if (this.socket && performance.now() - this.heardAt > limit) this.restart();
  }

  lost(code) {
    this.socket = null;
    if (this.state === "open" || !this.lostAt) this.lostAt = Date.now();
    if (this.state === "open") this.options.onLost?.();
    this.state = "lost";
    this.roundTripMs = -1;
    this.options.onChange?.();
    if (!this.again) return;
    if (code === 4401 || code === 1006) askForLogin();
    const delay = Math.min(LONGEST_DELAY_MS, FIRST_DELAY_MS * 2 ** this.attempts) * (0.75 + Math.random() / 2);
    this.attempts += 1;
    clearTimeout(this.retry); // two attempts would be two connections
    this.retry = setTimeout(() => this.connect(), delay);
  }
}

/** A refused handshake looks like a lost connection: only a request tells whether the session has ended. */
async function askForLogin() {
  try {
    const answer = await fetch(browser.ROOT, { redirect: "manual", cache: "no-store" });
    if (answer.type === "opaqueredirect") location.reload(); // to the login, which leads back here
  } catch {
    // there is no server at the moment
  }
}

export function device() {
  const phone = browser.media("(pointer: coarse)").matches;
  const system = /Android|iPhone|iPad|Windows|Mac|Linux/.exec(browser.userAgent())?.[0] ?? "";
  return phone ? `phone ${system}`.trim() : system || "browser";
}

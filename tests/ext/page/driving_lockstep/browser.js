/**
 * What pages need of a browser, in virtual time. Modules of the page use globals: these belong to the page that runs.
 *
 * A page that is blocked runs neither timers nor events: they wait, as in a browser whose main thread is busy or frozen.
 */

const REPEAT_AFTER = 0.25; // s, of a key that is held
const REPEAT_EVERY = 0.1;
const THROTTLED = 1; // timers of hidden pages
const SILENCE = 1.4; // s, a connection that has been silent for longer may be given up
const WAITING_REPEATS = 4; // of a key, while the page is blocked

export const world = { now: 0, epoch: 0, out: [], pages: new Map() };
let current = null;

class Socket {
  static OPEN = 1;

  constructor(url) {
    this.page = current;
    this.readyState = 0;
    this.number = current.sockets.length;
    this.url = url;
    current.sockets.push(this);
    this.page.emit("connect", this.number);
  }

  send(text) {
    if (this.readyState !== Socket.OPEN) throw new Error("InvalidStateError");
    this.page.emit("send", this.number, text);
  }

  close() {
    if (this.readyState >= 2) return;
    this.readyState = 2;
    this.page.emit("close", this.number);
  }

  /** Something has arrived from the network. */
  arrive(what, value) {
    if (what === "open" && this.readyState === 0) {
      this.readyState = Socket.OPEN;
      this.onopen?.();
    } else if (what === "message" && this.readyState === Socket.OPEN) {
      this.onmessage?.({ data: value });
    } else if (what === "closed" && this.readyState !== 3) {
      this.readyState = 3;
      this.onclose?.({ code: value });
    }
  }
}

/** One tab of a browser, with the keyboard before it. */
export class Page {
  /** @param {number} number @param {{token: string, drift: number, seed: number, mac: boolean}} options */
  constructor(number, options) {
    this.number = number;
    this.options = options;
    this.loaded = world.now;
    this.heard = world.now; // from the network
    this.touched = world.now; // by anything else
    this.paused = 0; // s, of performance.now()
    this.wall = 0; // ms, by which the wall clock was set
    this.random = options.seed;
    this.listeners = new Map();
    this.timers = new Map();
    this.timerNumber = 0;
    this.sockets = [];
    this.storage = new Map(options.token ? [["pebble-token", options.token]] : []);
    this.hidden = false;
    this.focused = true;
    this.dialog = false;
    this.pad = null;
    this.held = new Map(); // keys, as they are on the desk
    this.meta = false;
    this.repeating = null; // the key, and when it repeats
    this.blocked = false;
    this.asleep = false;
    /** @type {{kind: string, run: () => void}[]} */
    this.waiting = [];
  }

  emit(...output) {
    world.out.push([this.number, ...output]);
  }

  /** Run code of the page. */
  run(job) {
    const before = current;
    current = this;
    try {
      return job();
    } finally {
      current = before;
    }
  }

  /** Run an event of the page, as soon as it can. */
  soon(kind, job) {
    if (this.asleep && (kind === "input" || kind === "repeat")) return; // the computer sees no input
    if (!this.blocked) this.run(job);
    else if (kind !== "repeat" || this.waiting.filter((one) => one.kind === kind).length < WAITING_REPEATS)
      this.waiting.push({ kind, run: job });
  }

  perf() {
    return (world.now - this.loaded - this.paused) * 1000 * (1 + this.options.drift) + 100;
  }

  listen(where, name, listener) {
    const key = `${where} ${name}`;
    this.listeners.set(key, [...(this.listeners.get(key) ?? []), listener]);
  }

  /** Call the listeners now. */
  dispatch(where, name, event = {}) {
    this.run(() => {
      for (const listener of this.listeners.get(`${where} ${name}`) ?? []) listener(event);
    });
  }

  // -- timers

  timer(run, ms, repeats) {
    this.timerNumber += 1;
    this.timers.set(this.timerNumber, { due: world.now + (ms ?? 0) / 1000, run, period: repeats ? ms / 1000 : null });
    return this.timerNumber;
  }

  /** When something may happen. What timers of an idle page do shows nowhere: it is made up for later. */
  get due() {
    let due = this.repeating?.at ?? Infinity;
    if (this.blocked) return due;
    const idle = this.isIdle();
    if (idle) due = Math.min(due, this.heard + SILENCE);
    for (const timer of this.timers.values())
      if (!idle || timer.period === null) due = Math.min(due, timer.due);
    return due;
  }

  /** The first timer, whatever it does. */
  get next() {
    let due = this.repeating?.at ?? Infinity;
    if (!this.blocked) for (const timer of this.timers.values()) due = Math.min(due, timer.due);
    return due;
  }

  isIdle() {
    if (world.now < this.touched + 0.12 || world.now >= this.heard + SILENCE || this.pad) return false;
    if (this.socket.state !== "open") return false;
    const { gesture, inputs } = this.driver;
    return !gesture.active && !gesture.repeats.length && inputs.neutral && inputs.pointer === null;
  }

  /** Run what is due. */
  tick() {
    if (this.repeating && this.repeating.at <= world.now) this.repeatKey();
    if (!this.blocked) this.runTimers();
  }

  runTimers() {
    for (const [number, timer] of [...this.timers]) {
      if (timer.due > world.now || !this.timers.has(number)) continue;
      if (timer.period === null) this.timers.delete(number);
      else timer.due = world.now + (this.hidden ? Math.max(THROTTLED, timer.period) : timer.period);
      this.run(timer.run);
    }
  }

  /** Timers of a page that can be seen again are not throttled any more. */
  hurry() {
    for (const timer of this.timers.values())
      if (timer.period !== null) timer.due = Math.min(timer.due, world.now + timer.period);
  }

  // -- blocked and suspended

  block() {
    this.blocked = true;
  }

  /** @param {string[]} order in which the kinds of what has waited run */
  unblock(order) {
    if (!this.blocked) return;
    this.blocked = false;
    const waiting = this.waiting;
    this.waiting = [];
    for (const kind of order) {
      if (kind === "timers") this.runTimers();
      for (const one of waiting) if (kindOf(one) === kind) this.soon(one.kind, one.run);
    }
  }

  // -- keyboard

  get receives() {
    return this.focused && !this.hidden;
  }

  key(code, down) {
    if (down) {
      if (this.held.has(code)) return;
      this.held.set(code, world.now);
      this.repeating = { code, at: world.now + REPEAT_AFTER };
      if (this.receives) this.keyEvent("keydown", code, false);
    } else {
      if (!this.held.delete(code)) return;
      if (this.repeating?.code === code) this.repeating = null;
      if (this.receives && !(this.meta && this.options.mac)) this.keyEvent("keyup", code, false);
    }
  }

  metaKey(down) {
    this.meta = down;
    this.repeating = null;
    if (this.receives) this.keyEvent(down ? "keydown" : "keyup", "MetaLeft", false);
  }

  repeatKey() {
    this.repeating.at = world.now + REPEAT_EVERY;
    if (this.receives && !this.meta) this.keyEvent("keydown", this.repeating.code, true);
  }

  keyEvent(name, code, repeat, more = {}) {
    const event = { code, repeat, ctrlKey: false, altKey: false, metaKey: this.meta, ...more };
    event.key = code === "MetaLeft" ? "Meta" : code;
    event.target = { matches: () => false };
    event.preventDefault = () => {};
    event.timeStamp = this.perf();
    this.soon(repeat ? "repeat" : "input", () => this.dispatch("window", name, event));
  }
}

function kindOf(one) {
  return one.kind === "network" ? "network" : "input";
}

function define(name, get) {
  Object.defineProperty(globalThis, name, { get, configurable: true });
}

class PageDate extends Date {
  static now() {
    return (world.epoch + world.now) * 1000 + current.wall;
  }
}

const pageDocument = {
  get hidden() {
    return current.hidden;
  },
  hasFocus: () => current.focused && !current.hidden,
  querySelector: (selector) => (selector === "dialog[open]" && current.dialog ? {} : null),
  addEventListener: (name, listener) => current.listen("document", name, listener),
};

const pageStorage = {
  getItem: (key) => current.storage.get(key) ?? null,
  setItem: (key, value) => current.storage.set(key, value),
};

/** Replace node's own globals by those of the page that runs. */
export function install() {
  define("performance", () => ({ now: () => current.perf() }));
  define("Date", () => PageDate);
  define("document", () => pageDocument);
  define("navigator", () => ({ userAgent: "Linux", getGamepads: () => (current.pad ? [current.pad] : []) }));
  define("screen", () => ({ orientation: { addEventListener: (...what) => current.listen("screen", ...what) } }));
  define("location", () => ({ protocol: "http:", host: "127.0.0.1:8080", origin: "http://127.0.0.1:8080", assign: () => {} }));
  define("sessionStorage", () => pageStorage);
  define("matchMedia", () => () => ({ matches: false }));
  define("fetch", () => () => new Promise(() => {}));
  define("WebSocket", () => Socket);
  define("addEventListener", () => (name, listener) => current.listen("window", name, listener));
  define("setInterval", () => (run, ms) => current.timer(run, ms, true));
  define("setTimeout", () => (run, ms) => current.timer(run, ms, false));
  define("clearTimeout", () => (number) => current.timers.delete(number));
  define("clearInterval", () => (number) => current.timers.delete(number));
  Math.random = () => {
    current.random = (current.random * 1103515245 + 12345) % 2147483648;
    return current.random / 2147483648;
  };
}

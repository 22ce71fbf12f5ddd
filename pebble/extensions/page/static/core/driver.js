/** Ties inputs, gesture and control socket together: from events of the browser to drive commands. */

import * as browser from "./browser.js";
import { Escapes } from "./escapes.js";
import { Gesture, PERIOD_MS, PageClock, STALL_MS } from "./gesture.js";
import { DRIVE_KEYS, Inputs, PadStops } from "./inputs.js";
import { Lease } from "./lease.js";
import { SLOW_MS, SLOW_SPEED, driveReason } from "./reasons.js";
import { callAll } from "./store.js";

const PRESSED = "button, [role=button], summary, a, input[type=checkbox], input[type=radio]"; // by the space bar, too
const TYPING = "input:not([type=range]):not([type=checkbox]):not([type=radio]), select, textarea, [contenteditable]";

/**
 * What the page shows of the robot: ``pictureAge`` in ms; NaN: unknown; null: none is wanted here. ``isLoading``: what
 * shows the picture and the reasons is not here yet. ``isOld``: it is older than the server.
 * @typedef {{nameOf: (ref: string) => string, isOld: () => boolean, isLoading: () => boolean, pictureAge: () => number | null}} PageView
 */

export class Driver {
  /**
   * @param {{socket: any, store: any, estop: any, page?: Partial<PageView>}} parts ``page``: what the page shows
   */
  constructor({ socket, store, estop, page = {} }) {
    this.socket = socket;
    this.store = store;
    this.estop = estop;
    /** @type {PageView} */
    this.page = { nameOf: (ref) => ref.split("/").pop() ?? "", isOld: () => false, isLoading: () => false, pictureAge: () => null, ...page };
    this.lease = new Lease(store, socket);
    this.clock = new PageClock();
    this.ref = "";
    this.inputs = new Inputs();
    this.gesture = new Gesture((command) => this.socket.send({ op: "drive", ref: this.ref, ...command }));
    this.sliders = { speed: 0.6, turn: 0.6, balance: 0 };
    this.inSight = false; // the driver sees the robot itself
    /** @type {() => void} called when something ends gestures: a talk ends with them */
    this.onInterrupt = () => {};
    /** @type {(id: string, phase: "down" | "up") => void} what else keys and buttons do; "up" is of those that are held */
    this.onAction = () => {};
    /** @type {(() => void) | null} what the space bar does where nothing can be driven: a replay plays and pauses */
    this.onSpace = null;
    /** @type {import("./actions.js").Actions | null} which keys and buttons these are; fetched later */
    this.actions = null;
    this.padStops = new PadStops();
    /** @type {import("./pads.js").Pads | null} fetched later; until then gamepads only stop */
    this.pads = null;
    this.output = { x: 0, z: 0, y: 0 };
    this.escapes = new Escapes(() => this.latch("Escape twice"));
    this.latchedAt = -Infinity; // when the component was last seen stopped
    /** @type {Set<string>} parts of the page that do not work */
    this.failed = new Set();
    this.refusal = ""; // why the server has ended the last gesture
    this.hintedAt = -Infinity; // when a person without control last tried to drive
    this.tried = false;
    /** @type {import("./reasons.js").Reason|null} why nothing moves it, whatever is sent; found by what is fetched later */
    this.doubt = null;
    /** @type {Set<() => void>} */
    this.watchers = new Set();
    this.shown = "";
  }

  /** Listen to the window; to be called once. */
  start() {
    addEventListener("keydown", (event) => this.keyDown(event), true);
    addEventListener("keyup", (event) => this.keyUp(event), true);
    for (const name of ["blur", "pagehide"]) addEventListener(name, () => this.leave());
    document.addEventListener("freeze", () => this.leave());
    document.addEventListener("visibilitychange", () => document.hidden && this.leave());
    document.addEventListener("fullscreenchange", () => this.escapes.fullScreenChanged());
    document.addEventListener("contextmenu", () => this.interrupt());
    browser.onTurn(() => this.interrupt());
    for (const name of ["focusin", "focusout"]) document.addEventListener(name, () => this.changed());
    addEventListener("gamepaddisconnected", () => this.tick());
    setInterval(() => this.tick(), PERIOD_MS);
  }

  /** @param {string} ref the component to drive; "" none */
  select(ref) {
    if (ref === this.ref) return;
    this.interrupt();
    this.gesture.repeats = []; // they would be sent to the other one
    this.ref = ref;
    this.lease.select(ref);
    this.inSight = false;
    this.latchedAt = -Infinity;
    this.refusal = "";
    this.socket.send({ op: "watch", ref });
    this.changed();
  }

  /** The connection was made anew. */
  opened() {
    this.gesture.reset();
    if (this.ref) this.socket.send({ op: "watch", ref: this.ref });
  }

  /** What was under way is over. */
  lost() {
    this.letGo();
    this.inputs.clear();
    this.gesture.reset();
    this.changed();
  }

  /** @param {{cmd: string, ref: string, g: number, why: string}} message */
  refused(message) {
    if (message.cmd === "drive" && message.ref === this.ref && this.gesture.refused(message.g)) {
      this.refusal = message.why;
      this.letGo();
    }
    this.changed();
  }

  /** @returns {import("./reasons.js").Reason|null} why this component cannot be driven now */
  reason() {
    return this.ref ? driveReason(this.situation()) : { code: "none", text: "No robot is chosen" };
  }

  /** All that counts for and against driving, at this moment. */
  situation() {
    const value = (metric) => this.store.get(this.ref, metric)?.value;
    const broker = this.store.get("", "web/broker")?.value;
    return {
      name: this.page.nameOf(this.ref),
      open: this.socket.state === "open" && !this.socket.outdated, // what is known is of the last connection
      connecting: this.socket.state === "connecting" || (this.socket.state === "open" && this.socket.outdated),
      broker: broker?.problem ?? "", // why the server cannot reach it
      reload: this.page.isOld(),
      drives: this.socket.you?.drives !== false, // false: not over this connection
      rights: this.socket.you?.rights ?? [],
      words: this.socket.you?.words ?? {}, // by code
      hidden: document.hidden,
      focus: document.hasFocus(),
      dialog: document.querySelector("dialog[open]") !== null,
      fromKeys: this.inputs.fromKeys,
      liveness: value("web/liveness"),
      estop: value("web/estop"),
      freeForMs: performance.now() - this.latchedAt, // since it was seen stopped
      capabilities: value("capabilities")?.value ?? {},
      driver: this.lease.view,
      driverIdleMs: this.lease.idleMs(), // since its last gesture; -1: that lasts, or is not known
      script: /** @type {import("./reasons.js").Script | undefined} */ (value("autonomy-status")),
      loading: this.page.isLoading(),
      pictureAgeMs: this.page.pictureAge(), // -1: none comes while it is driven
      inSight: this.inSight,
      roundTripMs: this.socket.roundTripMs,
      failed: [...this.failed][0] ?? "",
      padFrozen: this.inputs.padFrozen,
      mustRelease: this.gesture.mustRelease,
      refusal: this.refusal,
    };
  }

  take(over = false) {
    this.interrupt();
    this.lease.take(over);
  }

  /** Do not let drive who asks now. */
  keep() {
    this.lease.keep();
    this.changed();
  }

  /** Give control back, or ask for it no more. */
  release() {
    this.interrupt();
    this.lease.release();
  }

  /** The space bar: stops the robot, with or without the lease. */
  space() {
    this.stopped(() => this.socket.send({ op: "stop", ref: this.ref }));
  }

  /** End the gesture; what is held counts again after it was released. */
  interrupt() {
    this.inputs.clear();
    this.gesture.interrupt(performance.now());
    this.letGo();
    this.output = { x: 0, z: 0, y: 0 };
    this.changed();
  }

  /** What else is held ends, too; a little later, so that it cannot keep a stop from being sent. */
  letGo() {
    this.actions?.clear();
    queueMicrotask(this.onInterrupt);
  }

  /** The window has lost the keyboard, or the page is hidden. */
  leave() {
    this.inputs.leave();
    this.interrupt();
  }

  /** @param {number} pointer @param {number} at performance.now() of the event @returns {boolean} whether it moves the stick */
  stickStart(pointer, at = performance.now()) {
    return !isOld(at) && this.inputs.stickStart(pointer);
  }

  /** @param {number} x @param {number} z each -1..1; ignored after the gesture was interrupted */
  stick(x, z) {
    if (this.inputs.pointer !== null) this.inputs.stickMove(x, z);
    this.update();
  }

  stickEnd() {
    this.inputs.stickEnd();
    this.update();
  }

  /** A button for the auxiliary axis. @param {string} name @param {number} value 0: released @param {number} at as above */
  hold(name, value, at = performance.now()) {
    if (!value || !isOld(at)) this.inputs.hold(name, value);
    this.update();
  }

  /** Whether keys go to a field or a list, and not to the robot. */
  get typing() {
    return document.activeElement?.matches(TYPING) ?? false;
  }

  get gestureActive() {
    return this.gesture.active;
  }

  /** @param {() => void} watcher @returns {() => void} */
  onChange(watcher) {
    this.watchers.add(watcher);
    return () => this.watchers.delete(watcher);
  }

  keyUp(event) {
    this.actions?.keyUp(event.code);
    if (isMeta(event)) this.leave();
    else if (this.inputs.keyUp(event.code)) this.update();
  }

  keyDown(event) {
    if (isMeta(event)) this.leave(); // macOS does not report which keys are released while it is held
    if (event.code === "Escape" && !event.repeat) this.escapes.press(event.timeStamp);
    const stop = stopKeys(event);
    if (stop) {
      event.preventDefault();
      if (!event.repeat) this.latch(stop);
      return;
    }
    if (event.target.matches?.(TYPING)) return;
    if (event.code === "Space") {
      const button = event.target.matches?.(PRESSED);
      if (!button) event.preventDefault();
      if (this.onSpace && !this.ref) {
        if (!button && !event.repeat) this.onSpace();
      } else if (!button || !event.repeat) this.space(); // a button that is held by it stays held
    } else if (event.ctrlKey || event.altKey || event.metaKey) {
      // a shortcut of the browser
    } else if (event.code === "Enter" && !event.repeat && !event.target.matches?.(PRESSED) && this.isFree()) {
      event.preventDefault();
      this.take();
    } else if (DRIVE_KEYS.has(event.code) && this.ref && !isOwn(event)) {
      if (document.querySelector("dialog[open]")) return;
      event.preventDefault();
      this.inputs.keyDown(event.code, event.repeat || isOld(event.timeStamp));
      this.update();
    } else if (!isOld(event.timeStamp) && this.actions?.keyDown(event)) event.preventDefault();
  }

  latch(why) {
    this.stopped(() => this.estop.press(this.ref, why)); // without an open component: all
  }

  /** @returns {boolean} whether all that is missing to drive is control, which anybody may take */
  isFree() {
    return this.ref !== "" && !document.querySelector("dialog[open]") && this.reason()?.action?.kind === "take";
  }

  /** A person tries to drive: without control the page tells how to get it. */
  hint() {
    if (!this.isFree()) return;
    this.hintedAt = performance.now();
    this.changed();
  }

  /** A stop is sent, whatever else fails. @param {() => void} send */
  stopped(send) {
    try {
      this.interrupt();
    } finally {
      send();
    }
  }

  tick() {
    this.attempt("gamepads", () => this.readPads());
    this.attempt("update", () => this.update());
    this.attempt("control", () => this.lease.watch());
    this.attempt("lists", () => this.escapes.look());
  }

  /** What fails ends the gesture and is said; the others go on. @param {string} part @param {() => void} run */
  attempt(part, run) {
    try {
      run();
      this.failed.delete(part);
    } catch (error) {
      if (!this.failed.has(part)) console.error(error);
      this.fail(part, true);
    }
  }

  /** A part of the page does not work: what it shows may be old, and nothing is driven. @param {string} part @param {boolean} fails */
  fail(part, fails) {
    if (!fails) this.failed.delete(part);
    else if (!this.failed.has(part)) {
      this.failed.add(part);
      this.inputs.clear();
      this.gesture.interrupt(performance.now());
      this.output = { x: 0, z: 0, y: 0 };
    }
    queueMicrotask(() => this.changed());
  }

  readPads() {
    const shown = browser.gamepads() ?? [];
    const stop = this.padStops.read(shown); // before all that may fail
    if (stop === "latch") this.latch("gamepad");
    else if (stop) this.space();
    this.pads?.read(shown, performance.now());
  }

  update() {
    const now = performance.now();
    const gap = this.clock.look(now);
    if (gap) this.leave();
    if (gap === "suspended") this.socket.restart();
    if (this.store.get(this.ref, "web/estop")?.value.latched) this.latchedAt = now;
    const situation = this.ref ? this.situation() : null;
    const why = situation && driveReason({ ...situation, mustRelease: false });
    const slow = this.socket.roundTripMs >= SLOW_MS ? SLOW_SPEED : 1;
    const vector = this.inputs.vector({ ...this.sliders, speed: Math.min(this.sliders.speed, slow) });
    const { neutral, waiting } = this.inputs;
    const tries = vector.x !== 0 || vector.z !== 0 || vector.y !== 0;
    if (tries && !this.tried) this.hint();
    this.tried = tries;
    const { active } = this.gesture;
    this.gesture.update(vector, situation !== null && why === null, now, neutral, waiting.size > 0);
    if (active && this.gesture.mustRelease) this.letGo();
    if (this.gesture.mustRelease) this.inputs.clearKeys();
    else this.refusal = "";
    this.output = this.gesture.active ? vector : { x: 0, z: 0, y: 0 };
    this.changed();
  }

  /** Notify watchers, if what they show is another than before. */
  changed() {
    const { x, z, y } = this.output;
    const { ref, pads, sliders, inSight, typing, lease } = this;
    const pad = pads && [pads.key, pads.reasons()];
    const shown = JSON.stringify([ref, this.reason(), x, z, y, pad, sliders, inSight, typing, this.hintedAt, lease.asks]);
    if (shown === this.shown) return;
    this.shown = shown;
    callAll(this.watchers);
  }
}

/** Whether an event has waited for a page that stood still: perhaps the key was released long ago. */
function isOld(at) {
  return performance.now() - at > STALL_MS;
}

function isMeta(event) {
  return event.key === "Meta" || event.key === "OS";
}

/** The keys of an emergency stop; "" none. Input methods may take Ctrl+Space; what fills in a field has no code. */
function stopKeys({ code = "", ctrlKey, metaKey }) {
  if (code.endsWith("Enter") && (ctrlKey || metaKey)) return "Ctrl+Enter";
  return code === "Space" && ctrlKey ? "Ctrl+Space" : "";
}

/** Arrows move a slider that has the focus; letters drive also then. */
function isOwn(event) {
  return event.code.startsWith("Arrow") && event.target.matches?.("input[type=range], input[type=radio], [data-arrows]");
}

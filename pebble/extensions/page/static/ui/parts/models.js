// What the page knows besides the store: its connection, its address, its settings, and the picture.

import * as browser from "../../core/browser.js";
import { callAll } from "../../core/store.js";

/** Whether this screen only watches: nothing but stops is sent. It is in the address, so it outlives everything. */
export const WATCHES = new URLSearchParams(globalThis.location?.search).has("watch");

/** Something that widgets follow. */
export class Model {
  constructor() {
    /** @type {Set<() => void>} */
    this.followers = new Set();
  }

  /** @param {() => void} fn @returns {() => void} unsubscribe */
  onChange(fn) {
    this.followers.add(fn);
    return () => this.followers.delete(fn);
  }

  changed() {
    callAll(this.followers);
  }
}

const MOST_ANSWERS = 200;

/** @typedef {import("../../messages.js").Done | import("../../messages.js").Refused} Answer */

/** The state of the control socket, and what the server answered. */
export class Connection extends Model {
  constructor(version) {
    super();
    this.version = version;
    this.socket = null; // set by main.js
    this.bye = null;
    /** @type {{text: string, at: number} | null} */
    this.notice = null;
    /** @type {Map<number, Answer>} what came of the newest commands, by their numbers */
    this.answers = new Map();
    /** @type {((message: any) => void) | null} */
    this.onLogs = null;
    this.unread = 0; // notices
  }

  get state() {
    return this.socket.state;
  }

  get you() {
    return this.socket.you;
  }

  get isOpen() {
    return this.state === "open";
  }

  /** States in the server's words, by their codes. */
  get words() {
    return this.you?.words ?? {};
  }

  /** The page was loaded before the server was updated. */
  get isOld() {
    return this.you !== null && this.you.version !== this.version;
  }

  /** @param {string} right @param {boolean} [named] at a robot that checks names */
  may(right, named) {
    return this.isOpen && !WATCHES && ((named ? this.you?.named_rights : this.you?.rights) ?? []).includes(right);
  }

  /** @param {Answer} message what the server did or refused to do */
  answered(message) {
    if (!message.n) return;
    this.answers = new Map([...this.answers, /** @type {[number, Answer]} */ ([message.n, message])].slice(-MOST_ANSWERS));
    this.changed();
  }

  /** Show a text for a few seconds. @param {string} text */
  show(text) {
    this.notice = { text, at: performance.now() };
    this.changed();
  }
}

/** Which component is open: "" is the fleet. */
export class Route extends Model {
  constructor() {
    super();
    addEventListener("popstate", () => this.changed());
  }

  get ref() {
    return below("r/") ?? "";
  }

  /** Of which component the recordings are shown; "" one is to be chosen; null: no recordings are. @returns {string | null} */
  get replay() {
    return below("replay")?.slice(1) ?? null;
  }

  /** @param {string} ref @returns {string} the address of its screen, which only watches if this one does */
  static path(ref, watches = WATCHES) {
    const path = browser.ROOT + (ref && `r/${ref.split("/").map(encodeURIComponent).join("/")}`);
    return watches ? `${path}?watch` : path;
  }

  go(ref) {
    if (ref !== this.ref || this.replay !== null) this.open(Route.path(ref));
  }

  /** @param {string} path */
  open(path) {
    history.pushState(null, "", path);
    scrollTo(0, 0);
    this.changed();
  }
}

/** @param {string} folder below ROOT @returns {string | null} the rest of the page's path; null: it is elsewhere */
function below(folder) {
  const path = location.pathname;
  const begin = browser.ROOT + folder;
  return path.startsWith(begin) ? browser.attempt(() => decodeURIComponent(path.slice(begin.length)), "") : null;
}

/** What is remembered in this browser. Private windows may refuse to remember anything. */
export class Settings extends Model {
  constructor() {
    super();
    this.theme = read("theme", "auto");
    this.thumbnails = read("thumbnails", true) === true;
    this.sort = read("sort", "name");
    this.begun = list(read("begun", [])); // of what is shown to who is here for the first time
    this.name = read("name", "");
    this.side = read("side", "right"); // of the stick, on a phone
    this.hints = read("hints", true); // which keys drive
    this.forgotten = new Set(list(read("forgotten", [])));
    this.apply();
  }

  /** @param {"theme" | "thumbnails" | "sort" | "name" | "side" | "hints"} name @param {any} value */
  set(name, value) {
    Object.assign(this, { [name]: value });
    write(name, value);
    this.apply();
    this.changed();
  }

  apply() {
    const root = document.documentElement;
    if (this.theme === "light" || this.theme === "dark") root.dataset.theme = this.theme;
    else delete root.dataset.theme;
    root.dataset.side = this.side;
    root.toggleAttribute("data-watch", WATCHES);
  }

  forget(ref, forgotten = true) {
    if (forgotten) this.forgotten.add(ref);
    else this.forgotten.delete(ref);
    write("forgotten", [...this.forgotten]);
    this.changed();
  }

  /** @param {string} what of the first time was done, or "hidden" */
  begin(what) {
    if (this.begun.includes(what)) return;
    this.begun = [...new Set([...this.begun, what])];
    write("begun", this.begun);
    this.changed();
  }
}

/** Which panel is open above the screen; "" none. */
export class Panels extends Model {
  shown = "";

  /** @param {"" | "settings" | "help" | "phone"} name */
  show(name) {
    this.shown = name;
    this.changed();
  }

  toggle(name) {
    this.show(this.shown === name ? "" : name);
  }
}

/** Which cards of a component are closed or hidden. Those for engineers are closed until they are opened. */
export class CardView extends Model {
  /** @param {string} ref */
  constructor(ref) {
    super();
    this.key = `cards ${ref}`;
    const stored = read(this.key, null);
    this.closed = new Set(list(stored?.closed));
    this.opened = new Set(list(stored?.opened));
    this.hidden = new Set(list(stored?.hidden));
    this.wanted = ""; // a card that is to be looked at now
  }

  isClosed(id, isFirst = false) {
    return isFirst ? !this.opened.has(id) : this.closed.has(id);
  }

  toggle(id, isFirst = false) {
    const set = isFirst ? this.opened : this.closed;
    if (!set.delete(id)) set.add(id);
    this.save();
  }

  hide(id) {
    this.hidden.add(id);
    this.save();
  }

  show(id) {
    this.hidden.delete(id);
    this.save();
  }

  /** Show a card, open, in sight. */
  reveal(id) {
    this.hidden.delete(id);
    this.closed.delete(id);
    this.opened.add(id);
    this.wanted = id;
    this.save();
  }

  save() {
    const { closed, opened, hidden } = this;
    write(this.key, { closed: [...closed], opened: [...opened], hidden: [...hidden] });
    this.changed();
  }
}

/** What this browser remembers. @param {string} name @param {any} otherwise @returns {any} */
export function read(name, otherwise) {
  try {
    return JSON.parse(browser.local.get(`pebble ${name}`) ?? "null") ?? otherwise;
  } catch {
    return otherwise;
  }
}

/** @param {string} name @param {any} value */
export function write(name, value) {
  browser.local.set(`pebble ${name}`, JSON.stringify(value));
}

const list = (value) => (Array.isArray(value) ? value.filter((one) => typeof one === "string") : []);

/** What a component offers, by its capabilities; a robot without any is assumed to have a camera. */
export class Offers {
  /** @param {string} ref @param {any} capabilities payload @param {string[]} [metrics] that were received of it */
  constructor(ref, capabilities, metrics = []) {
    this.metrics = metrics;
    this.isRobot = ref.split("/")[1] === "robots";
    this.known = Boolean(capabilities?.value);
    this.value = capabilities?.value ?? {};
    this.assumed = !this.known && this.isRobot;
  }

  section(name) {
    return this.value[name] ?? {};
  }

  /** Whether it has a section that people use; assumed of a robot without capabilities, as the original page does. */
  has(name) {
    const section = this.section(name);
    return this.assumed || section.available === true || (name === "system" && ("reboot" in this.value || Object.keys(section).length > 0));
  }

  /** @param {string} prefix @returns {boolean} whether any such metric was received */
  received(prefix) {
    return this.metrics.some((metric) => metric.startsWith(prefix));
  }

  get drives() {
    return this.section("drive").available === true;
  }

  /** Whether it has an axis besides turning and going; one that does not list its axes may. */
  get hasExtraAxis() {
    const { axes } = this.section("drive");
    return !Array.isArray(axes) || axes.includes("y");
  }

  /** Whether a stop means anything to it. */
  get stops() {
    return this.isRobot || this.drives || Object.keys(this.section("estop")).length > 0;
  }

  get hasVideo() {
    return this.assumed || this.section("video").available === true;
  }
}

/** What browsers may lack, deny or take away. It is tried here and nowhere else, and every answer can be used as it is. */

/** @template T @param {() => T} fn @param {T} otherwise @returns {T} */
export function attempt(fn, otherwise) {
  try {
    return fn() ?? otherwise;
  } catch {
    return otherwise;
  }
}

/** Texts by name. What the browser does not take is remembered until the page is left. */
class Memory {
  /** @param {"localStorage" | "sessionStorage"} kind */
  constructor(kind) {
    this.kind = kind;
    /** @type {Map<string, string>} */
    this.own = new Map();
  }

  /** @param {string} key @returns {string | null} */
  get(key) {
    return this.own.get(key) ?? attempt(() => globalThis[this.kind].getItem(key), null);
  }

  /** @param {string} key @param {string} value @returns {boolean} whether it outlives the page */
  set(key, value) {
    const kept = attempt(() => {
      globalThis[this.kind].setItem(key, value);
      return globalThis[this.kind].getItem(key) === value;
    }, false);
    if (kept) this.own.delete(key);
    else this.own.set(key, value);
    return kept;
  }
}

export const local = new Memory("localStorage");
export const session = new Memory("sessionStorage");

/** @returns {any[] | null} as the browser shows them, with holes; null: it shows none to this page */
export const gamepads = () => attempt(() => Array.from(navigator.getGamepads() ?? []), null);

/** @param {number} bytes @returns {string} hexadecimal; not secret, only unlike all others */
export function randomHex(bytes) {
  const guess = () => Uint8Array.from({ length: bytes }, () => 256 * Math.random());
  const random = attempt(() => crypto.getRandomValues(new Uint8Array(bytes)), null) ?? guess();
  return Array.from(random, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

export const userAgent = () => attempt(() => navigator.userAgent, "");

/** @param {() => void} fn called when the screen was turned */
export const onTurn = (fn) => attempt(() => screen.orientation.addEventListener("change", fn), undefined);

const nothing = () => {};

const blind = /** @type {any} */ ({ observe: nothing, disconnect: nothing });

/** @param {ResizeObserverCallback} fn @returns {ResizeObserver} */
export const sizes = (fn) => attempt(() => new ResizeObserver(fn), blind);

const unknown = /** @type {any} */ ({ matches: false, addEventListener: nothing, removeEventListener: nothing });

/** @param {string} query @returns {MediaQueryList} */
export const media = (query) => attempt(() => matchMedia(query), unknown);

/** So that moves of a finger are seen wherever it goes. @param {any} event */
export const capture = ({ currentTarget, pointerId }) =>
  attempt(() => currentTarget.setPointerCapture(pointerId), undefined); // it may be gone already

export const fullScreen = {
  get possible() {
    return attempt(() => Boolean(document.documentElement.requestFullscreen) && document.fullscreenEnabled, false);
  },
  get on() {
    return attempt(() => Boolean(document.fullscreenElement), false);
  },
  left: false, // by a button of the page, not by a key
  toggle() {
    this.left = this.on;
    const change = () => (this.on ? document.exitFullscreen() : document.documentElement.requestFullscreen());
    attempt(change, undefined)?.catch(nothing);
  },
};

/** @returns {any} the list, or other chooser, that is open over the page; null: none, or this browser does not tell */
export const openList = () => attempt(() => document.activeElement.closest("select:open, input:open"), null);

/** @param {URL | string} url of a module @returns {Worker} or an error is thrown */
export const worker = (url) => new Worker(url, { type: "module" });

/** Where our server begins: below any path of a proxy, modules are three folders further. "/", "/robots/" */
export const ROOT = new URL("../../../", import.meta.url).pathname;

/** @param {string} path below ROOT @returns {WebSocket | null} */
export const webSocket = (path) =>
  attempt(() => new WebSocket(`${location.origin.replace("http", "ws")}${ROOT}${path}`), null);

/** @param {string} name of a class or function @returns {any} undefined: it is not here */
export const find = (name) => attempt(() => globalThis[name], undefined);

// uPlot writes numbers in the browser's language, which some systems call "C" or "en-US@posix": no browser knows these.
const takesLanguage = attempt(() => Boolean(new Intl.NumberFormat(navigator.language)), false);
if (!takesLanguage) attempt(() => Object.defineProperty(navigator, "language", { value: "en" }), null);

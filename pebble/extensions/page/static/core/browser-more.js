/** What is not needed at once of what browsers may lack, deny or take away; see browser.js. */

import { attempt } from "./browser.js";

/** @returns {WakeLock | undefined} */
export const wakeLock = () => attempt(() => navigator.wakeLock, undefined);

export const microphone = {
  get possible() {
    return attempt(() => Boolean(navigator.mediaDevices.getUserMedia) && "AudioWorkletNode" in globalThis, false);
  },
  /** @param {MediaStreamConstraints} wanted */
  open: async (wanted) => navigator.mediaDevices.getUserMedia(wanted),
};

/** @returns {Promise<any>} what is printed on the keys; null: not in this browser, or in a frame of another site */
export const keyboardLayout = async () => attempt(() => /** @type {any} */ (navigator).keyboard.getLayoutMap(), null);

/** @param {string} host @returns {boolean} whether no other machine can reach it */
export const isLoopback = (host) => /^(127\.[\d.]+|0\.0\.0\.0|\[::1?\]|localhost|.*\.localhost)$/.test(host);

export const DEMO = "demo"; // what the server of `make demo` calls itself

/** @param {(seen: boolean) => void} fn @param {string} [rootMargin] around the screen @returns {IntersectionObserver} */
export const sight = (fn, rootMargin = "0px") =>
  attempt(
    () => new IntersectionObserver((all) => fn(all[all.length - 1].isIntersecting), { rootMargin }),
    /** @type {any} */ ({ observe: () => fn(true), disconnect() {} }),
  );

// The picture of one component: what was drawn last, and how old that is. The canvas outlives every layout.

import { PICTURE_OLD_MS } from "../../core/reasons.js";
import { Model } from "../parts/models.js";

const STALE_MS = 500; // without a new picture, what is shown is no longer live
const ROUNDED = 0.03; // of width by height
const WRONG_MS = 1000; // a clock that is so far off is not believed

/** Owner of the canvas and of the connection for pictures. */
export class Video extends Model {
  /** @param {import("../../core/store.js").Store} store */
  constructor(store) {
    super();
    this.store = store;
    this.canvas = document.createElement("canvas");
    this.canvas.width = 640;
    this.canvas.height = 360;
    this.context = this.canvas.getContext("2d");
    this.ratio = 0; // of its box
    this.ref = ""; // whose picture is shown
    this.pictures = null; // set by main.js
    this.forget();
  }

  forget() {
    /** @type {any} */
    this.info = null;
    this.drawnAt = -Infinity;
    this.interval = 0; // ms between pictures
    this.state = null;
    this.stream = ""; // the address of the robot's own one, while it is shown instead
  }

  /** Show pictures of ``ref``; "" none. @param {string} ref */
  show(ref) {
    if (ref === this.ref) return;
    this.ref = ref;
    this.forget();
    this.shape();
    if (ref) this.pictures?.show(ref);
    else this.pictures?.stop();
    this.changed();
  }

  /** Give the canvas the shape that the pictures will have, so that nothing moves when the first one comes. */
  shape() {
    const { width, height } = this.store.get(this.ref, "capabilities")?.value?.value?.video ?? {};
    const plausible = (size) => Number.isInteger(size) && size >= 16 && size <= 4096;
    if (plausible(width) && plausible(height)) this.resize(width, height);
  }

  /** Cameras change the size of their pictures, and round it: what differs by that leaves the box as it is. */
  resize(width, height) {
    const ratio = width / height;
    Object.assign(this.canvas, { width, height });
    if (Math.abs(ratio - this.ratio) < ROUNDED) return;
    this.ratio = ratio;
    this.canvas.style.aspectRatio = String(ratio);
  }

  /** @param {any} bitmap a VideoFrame, or an ImageBitmap @param {any} info */
  draw(bitmap, info) {
    const { canvas } = this;
    const width = bitmap.displayWidth ?? bitmap.width;
    const height = bitmap.displayHeight ?? bitmap.height;
    if (canvas.width !== width || canvas.height !== height) this.resize(width, height);
    this.context.drawImage(bitmap, 0, 0);
    const now = this.store.clock();
    const since = now - this.drawnAt;
    if (since < 10_000) this.interval = this.interval ? 0.8 * this.interval + 0.2 * since : since;
    const first = this.info === null;
    this.drawnAt = now;
    this.info = info;
    if (first) this.changed();
  }

  /** @param {any} state of Pictures */
  report(state) {
    this.state = state;
    this.changed();
  }

  /** ms since the last picture arrived; Infinity: there was none. */
  get sinceDrawn() {
    return this.store.clock() - this.drawnAt;
  }

  get hasStopped() {
    return this.sinceDrawn > Math.max(STALE_MS, 2.5 * this.interval);
  }

  /** Whether no picture comes while it is driven: its link carries too little for both. */
  get waits() {
    return this.store.get(this.ref, "link")?.value?.level === "thin";
  }

  get isStale() {
    return this.hasStopped || this.age().ms > PICTURE_OLD_MS;
  }

  /** How old the picture is in ms: since it was taken, or, if the component's clock is wrong, since it arrived. */
  age() {
    if (this.stream) return { ms: NaN, since: "unknown" };
    const captured = this.info?.capturedMs;
    if (typeof captured === "number" && captured > 0 && this.clockIsRight) {
      const ms = this.store.now() - captured;
      if (ms > -WRONG_MS && ms < 3_600_000) return { ms: Math.max(ms, this.sinceDrawn), since: "taken" };
    }
    return { ms: this.sinceDrawn, since: "arrived" };
  }

  /** Heartbeats carry the component's clock: one that is more than a second off says nothing about pictures. */
  get clockIsRight() {
    const view = this.store.get(this.ref, "web/liveness")?.value;
    return Boolean(view) && !view.whole_seconds && view.latency_ms !== null && view.latency_ms < WRONG_MS;
  }
}

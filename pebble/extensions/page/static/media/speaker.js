// The loudspeaker of this page: what the worker of sound pushes is played by an AudioWorklet.

import * as browser from "../core/browser.js";

const WORKLET = new URL("./playout-worklet.js", import.meta.url).href;

export class Speaker {
  constructor() {
    /** @type {AudioContext|null} */
    this.context = null;
    /** @type {GainNode|null} */
    this.gain = null;
    /** @type {AudioWorkletNode|null} */
    this.node = null;
    /** @type {Promise<void>|null} */
    this.opening = null;
  }

  /** To be called in a click. @returns {AudioContext} running as soon as the browser lets it */
  start() {
    if (!this.context) {
      this.context = new (browser.find("AudioContext"))({ latencyHint: "interactive" });
      this.gain = this.context.createGain();
      this.gain.connect(this.context.destination);
    }
    this.context.resume();
    return this.context;
  }

  /** @returns {Promise<void>} once it can play; an error is thrown where it cannot */
  async ready() {
    this.opening ??= this.open(this.start());
    try {
      await this.opening;
    } catch (error) {
      this.opening = null; // the next one tries again
      throw error;
    }
  }

  /** @param {AudioContext} context */
  async open(context) {
    await context.audioWorklet.addModule(WORKLET);
    this.node = new (browser.find("AudioWorkletNode"))(context, "pebble-playout", { numberOfInputs: 0, outputChannelCount: [2] });
    this.node.connect(/** @type {GainNode} */ (this.gain));
  }

  /** Play what comes by this port. @param {MessagePort} port of the worker */
  attach(port) {
    this.node?.port.postMessage({ port }, [port]);
  }

  /** @param {boolean} muted */
  mute(muted) {
    if (this.gain) this.gain.gain.value = muted ? 0 : 1;
  }
}

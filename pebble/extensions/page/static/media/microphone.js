// The microphone, opened while a person talks and for a moment after it.

import * as browser from "../core/browser.js";
import * as more from "../core/browser-more.js";

const KEEP_MS = 5000; // it stays open between two sentences
const WORKLET = new URL("./capture-worklet.js", import.meta.url).href;
const WANTED = { audio: { echoCancellation: true, channelCount: 1 } };
/** @type {Record<string, string>} */
const PROBLEMS = {
  NotAllowedError: "The microphone is blocked: allow it for this page in the browser",
  NotFoundError: "There is no microphone",
  NotReadableError: "The microphone is in use by another program",
};

export class Microphone {
  /** @param {AudioContext} context */
  constructor(context) {
    this.context = context;
    /** @type {MediaStream|null} */
    this.stream = null;
    /** @type {MediaStreamAudioSourceNode|null} */
    this.source = null;
    /** @type {AudioWorkletNode|null} */
    this.node = null;
    /** @type {Promise<string>|null} */
    this.opening = null;
    this.timer = 0;
  }

  /** Open it, which may ask the person first. @returns {Promise<string>} why it is not open; "" it is */
  open() {
    clearTimeout(this.timer);
    return (this.opening ??= this.acquire().finally(() => (this.opening = null))); // of two, one would stay open
  }

  async acquire() {
    try {
      if (!this.node) {
        await this.context.audioWorklet.addModule(WORKLET);
        this.node = new (browser.find("AudioWorkletNode"))(this.context, "pebble-capture", { numberOfInputs: 1, numberOfOutputs: 1 });
        this.node.connect(this.context.destination); // what leads nowhere is not called; it plays nothing
      }
      if (!this.stream?.active) {
        this.close();
        this.stream = await more.microphone.open(WANTED);
        this.source = this.context.createMediaStreamSource(this.stream);
        this.source.connect(this.node);
      }
      return "";
    } catch (error) {
      this.close();
      const { name, message } = /** @type {Error} */ (error);
      return PROBLEMS[name] ?? `The microphone cannot be opened: ${message}`;
    }
  }

  /** Begin. @param {MessagePort} port of the worker that takes its samples */
  attach(port) {
    this.mute(false);
    this.node?.port.postMessage({ port }, [port]);
  }

  /** Give it back soon. */
  release() {
    this.mute(true);
    this.node?.port.postMessage({ port: null });
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.close(), KEEP_MS);
  }

  close() {
    clearTimeout(this.timer);
    for (const track of this.stream?.getTracks() ?? []) track.stop();
    this.source?.disconnect();
    this.stream = this.source = null;
  }

  /** @param {boolean} muted */
  mute(muted) {
    for (const track of this.stream?.getTracks() ?? []) track.enabled = !muted;
  }
}

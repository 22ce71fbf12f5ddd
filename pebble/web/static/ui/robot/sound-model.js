// Listening to the component that is open, and talking to it: what is under way, and why not more.

import * as browser from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { device } from "../../core/control-socket.js";
import { Microphone } from "../../media/microphone.js";
import { makeSpeaker } from "../../media/speaker.js";
import { Model, Offers } from "../parts/models.js";
import { nameIn } from "../parts/looks.js";

const WORKER = new URL("../../media/sound-worker.js", import.meta.url).href;
const STEP_MS = 200; // while a person talks: the page tells the worker that it is alive
const KEEP_MS = 5000; // so long the robot's loudspeaker stays ready after a talk
const OWN_MS = 1500; // so long after a talk its name is still shown by the server

/** @typedef {{number: number, on: boolean}} Talk ``on``: the server takes it */

/** @typedef {import("../../media/playout.js").Stats} Stats */

export class Sound extends Model {
  /** @param {any} page its services */
  constructor({ store, connection, route }) {
    super();
    this.store = store;
    this.connection = connection;
    this.route = route;
    this.ref = ""; // of the component that the worker is connected to
    this.name = ""; // whose connection it is
    this.listening = false;
    this.muted = false;
    /** @type {Talk|null} */
    this.talking = null;
    this.held = false; // key or button: a talk that was interrupted does not go on
    this.problem = ""; // of the last attempt to listen or talk
    this.open = false; // whether the worker is connected
    /** @type {Stats|null} */
    this.stats = null;
    this.talks = 0;
    this.endedAt = -Infinity; // the last talk
    /** @type {AudioContext|null} */
    this.context = null;
    /** @type {GainNode|null} */
    this.gain = null;
    /** @type {Promise<{node: AudioNode, attach: (port: MessagePort) => void}>|null} */
    this.speaker = null;
    /** @type {Microphone|null} */
    this.microphone = null;
    /** @type {Worker|null} */
    this.worker = null;
    this.timer = 0;
    route.onChange(() => {
      if (route.ref === this.ref) return;
      this.problem = "";
      this.leave();
    });
    connection.onChange(() => this.worker && connection.isOpen && connection.you.user !== this.name && this.leave());
  }

  // -- listening

  /** To be called in a click: browsers start no sound by themselves. */
  async listen() {
    if (this.listening || this.listenReason()) return;
    this.silence();
    this.listening = true;
    this.muted = false;
    this.problem = "";
    const { ref } = this.route;
    try {
      const context = this.start();
      this.adjust();
      this.changed();
      this.speaker ??= makeSpeaker(context);
      const { node, attach } = await this.speaker;
      node.connect(/** @type {GainNode} */ (this.gain));
      if (!this.listening || this.route.ref !== ref) return; // stopped meanwhile
      this.silence();
      const { port1, port2 } = new MessageChannel();
      attach(port2);
      this.connect(ref, port1);
    } catch (error) {
      this.speaker = null;
      this.leave();
      this.problem = `Sound cannot be played: ${/** @type {Error} */ (error).message}`;
    }
    this.changed();
  }

  stopListening() {
    this.leave();
  }

  toggleMute() {
    if (!this.listening) return;
    this.muted = !this.muted;
    this.adjust();
    this.changed();
  }

  // -- talking

  /** Key or button: held or released. @param {boolean} on */
  talk(on) {
    if (on && !this.held) {
      this.held = true;
      this.begin();
    } else if (!on) {
      this.held = false;
      this.silence();
    }
  }

  async begin() {
    const why = this.talkReason();
    if (why) return this.connection.show(`Not done: ${why}`);
    /** @type {Talk} */
    const talk = { number: ++this.talks, on: false };
    const { ref } = this.route;
    this.talking = talk;
    this.problem = "";
    const problem = await this.speak(talk, ref).catch((error) => `Talking has failed: ${error.message}`);
    if (this.talking === talk && problem) this.silence(problem);
    if (this.talking) return;
    this.microphone?.close(); // it was released, perhaps to answer the browser's question
    if (problem && this.route.ref === ref) this.problem = problem;
    this.changed();
  }

  /** @param {Talk} talk @param {string} ref @returns {Promise<string>} why it cannot begin; "" it has, or has ended */
  async speak(talk, ref) {
    const context = this.start();
    this.adjust();
    if (!this.worker) this.connect(ref, null);
    clearInterval(this.timer);
    this.timer = setInterval(() => this.step(), STEP_MS);
    this.changed();
    const microphone = (this.microphone ??= new Microphone(context));
    const problem = await microphone.open();
    if (problem || this.talking !== talk) return problem;
    const { port1, port2 } = new MessageChannel();
    microphone.attach(port2);
    this.worker?.postMessage({ op: "talk", talk: talk.number, rate: context.sampleRate, port: port1 }, [port1]);
    return "";
  }

  /** While a talk lasts: its worker ends it unless the page shows that it runs; a dialog ends it, too. */
  step() {
    if (!this.talking && performance.now() - this.endedAt > KEEP_MS) {
      clearInterval(this.timer);
      if (!this.listening) this.leave();
    } else if (this.talking && document.querySelector("dialog[open]")) this.silence();
    else if (this.talking) this.worker?.postMessage({ op: "alive" });
  }

  /** What ends a gesture ends a talk; where the page is hidden, or frozen, no timer would close the microphone. */
  interrupt() {
    this.held = false;
    this.silence();
    this.microphone?.close();
  }

  /** End the talk. @param {string} [why] if the person did not */
  silence(why = "") {
    if (!this.talking) return;
    this.talking = null;
    this.endedAt = performance.now();
    if (why && why !== this.talkReason()) this.problem = why; // a reason that lasts is beside the button
    this.worker?.postMessage({ op: "end" });
    this.microphone?.release();
    this.adjust();
    this.changed();
  }

  // -- both

  /** The page leaves this component, or stops listening. */
  leave() {
    this.silence();
    clearInterval(this.timer);
    this.microphone?.close();
    this.listening = false;
    this.disconnect();
    this.context?.suspend();
    this.changed();
  }

  /** @returns {AudioContext} running as soon as the browser lets it */
  start() {
    if (!this.context) {
      this.context = new (browser.find("AudioContext"))({ latencyHint: "interactive" });
      this.gain = this.context.createGain();
      this.gain.connect(this.context.destination);
    }
    this.context.resume();
    return this.context;
  }

  /** Nothing is heard while a person talks: it would come back by the microphone. */
  adjust() {
    if (this.gain) this.gain.gain.value = this.muted || this.talking ? 0 : 1;
  }

  /** @param {string} ref @param {MessagePort|null} port where sound is played; null: this is only for talking */
  connect(ref, port) {
    this.disconnect();
    this.ref = ref;
    this.name = this.connection.you?.user ?? "";
    const worker = browser.worker(WORKER);
    worker.onmessage = ({ data }) => worker === this.worker && this.take(data);
    worker.onerror = ({ message = "a part of this page is missing" }) => {
      if (worker !== this.worker) return;
      this.leave();
      this.problem = `Sound has failed: ${message}. Try again`;
      this.changed();
    };
    const message = { op: "open", ref, name: this.name, device: device(), port, rate: this.context?.sampleRate };
    worker.postMessage(message, port ? [port] : []);
    this.worker = worker;
  }

  disconnect() {
    this.worker?.terminate();
    this.worker = null;
    this.ref = "";
    this.open = false;
    this.stats = null;
  }

  /** @param {any} message of the worker */
  take({ stats, connection, answer }) {
    if (stats) this.stats = stats;
    if (connection) this.open = connection === "open";
    if (connection === "lost") this.silence("The connection was lost");
    if (answer && this.talking?.number === answer.talk) {
      if (answer.on) this.talking.on = true;
      else this.silence(answer.why);
    }
    this.changed();
  }

  // -- why not

  /** @returns {string} why nothing can be heard now; "" it can */
  listenReason() {
    if (!this.connection.isOpen) return "No connection to the server";
    if (this.store.get("", "web/broker")?.value.connected === false) return "The server cannot reach the broker";
    if (!this.offers.has("audio")) return `${nameIn(this.store, this.route.ref)} has no sound`;
    return browser.find("AudioContext") ? "" : "This browser plays no sound";
  }

  /** @returns {string} why this page cannot talk now; "" it can */
  talkReason() {
    const why = this.listenReason();
    if (why) return why;
    if (!this.connection.may("drive")) return "Log in as driver to talk";
    if (!more.microphone.possible) return "Needs https";
    const { ref } = this.route;
    const name = nameIn(this.store, ref);
    if (this.store.get(ref, "web/liveness")?.value.online === false) return `${name} is silent`;
    const level = this.store.get(ref, "link")?.value?.level ?? "wide";
    if (level !== "wide") return `The connection of ${name} is too slow for a voice`; // the server says the same
    const view = this.store.get(ref, "web/sound")?.value;
    if (view?.state === "refused") return view.why;
    return this.talker ? `${this.talker} is talking` : "";
  }

  /** @returns {string} who else talks to this component */
  get talker() {
    const talker = this.store.get(this.route.ref, "web/sound")?.value.talker ?? "";
    const own = talker === this.connection.you?.user && performance.now() - this.endedAt < OWN_MS;
    return this.talking || own ? "" : talker;
  }

  get offers() {
    const { ref } = this.route;
    return new Offers(ref, this.store.get(ref, "capabilities")?.value);
  }
}

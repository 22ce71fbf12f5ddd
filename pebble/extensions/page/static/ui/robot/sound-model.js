// Listening to the component that is open, and talking to it: what is under way, and why not more.

import * as browser from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { device } from "../../core/control-socket.js";
import { Microphone } from "../../media/microphone.js";
import { Speaker } from "../../media/speaker.js";
import { Model, Offers } from "../parts/models.js";
import { nameIn } from "../parts/looks.js";
import { whyNotReached } from "../parts/why-not.js";

const WORKER = new URL("../../media/sound-worker.js", import.meta.url).href;
const STEP_MS = 200; // while a person talks: the page tells the worker that it is alive
const KEEP_MS = 5000; // so long the robot's loudspeaker stays ready after a talk
const OWN_MS = 1500; // so long after a talk its name is still shown by the server

/** @typedef {import("../../media/playout.js").Stats} Stats */

/** The worker of sound, while it is connected to one component. */
class Link {
  constructor() {
    /** @type {Worker|null} */
    this.worker = null;
    this.ref = ""; // of the component
    this.name = ""; // whose connection it is
    this.isOpen = false;
    /** @type {Stats|null} */
    this.stats = null;
  }

  /**
   * @param {{ref: string, name: string, port: MessagePort|null, rate: number|undefined}} of ``port``: where sound is
   * played; null: this is only for talking @param {(message: any) => void} onMessage
   * @param {(why: string) => void} onFailed
   */
  open({ ref, name, port, rate }, onMessage, onFailed) {
    this.close();
    Object.assign(this, { ref, name });
    const worker = browser.worker(WORKER);
    worker.onmessage = ({ data }) => worker === this.worker && onMessage(data);
    worker.onerror = ({ message = "a part of this page is missing" }) => worker === this.worker && onFailed(message);
    worker.postMessage({ op: "open", ref, name, device: device(), port, rate }, port ? [port] : []);
    this.worker = worker;
  }

  /** @param {any} message @param {MessagePort[]} [ports] */
  send(message, ports = []) {
    this.worker?.postMessage(message, ports);
  }

  close() {
    this.worker?.terminate();
    Object.assign(this, { worker: null, ref: "", isOpen: false, stats: null });
  }
}

/** What a person says: one talk after the other. */
class Voice {
  constructor() {
    this.held = false; // key or button: a talk that was interrupted does not go on
    /** @type {{number: number, on: boolean}|null} ``on``: the server takes it */
    this.talk = null;
    this.count = 0;
    this.endedAt = -Infinity; // the last talk
    this.timer = 0;
    /** @type {Microphone|null} */
    this.microphone = null;
  }

  begin() {
    return (this.talk = { number: ++this.count, on: false });
  }

  end() {
    this.talk = null;
    this.endedAt = performance.now();
    this.microphone?.release();
  }
}

export class Sound extends Model {
  /** @param {any} page its services */
  constructor({ store, connection, route }) {
    super();
    this.store = store;
    this.connection = connection;
    this.route = route;
    this.listening = false;
    this.muted = false;
    this.problem = ""; // of the last attempt to listen or talk
    this.speaker = new Speaker();
    this.link = new Link();
    this.voice = new Voice();
    route.onChange(() => {
      if (route.ref === this.link.ref) return;
      this.problem = "";
      this.leave();
    });
    connection.onChange(() => this.link.worker && connection.isOpen && connection.you.user !== this.link.name && this.leave());
  }

  get talking() {
    return this.voice.talk;
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
      this.speaker.start();
      this.adjust();
      this.changed();
      await this.speaker.ready();
      if (!this.listening || this.route.ref !== ref) return; // stopped meanwhile
      this.silence();
      const { port1, port2 } = new MessageChannel();
      this.speaker.attach(port2);
      this.connect(ref, port1);
    } catch (error) {
      this.leave();
      this.problem = `Sound cannot be played: ${/** @type {Error} */ (error).message}`;
    }
    this.changed();
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
    if (on && !this.voice.held) {
      this.voice.held = true;
      this.begin();
    } else if (!on) {
      this.voice.held = false;
      this.silence();
    }
  }

  async begin() {
    const why = this.talkReason();
    if (why) return this.connection.show(`Not done: ${why}`);
    const talk = this.voice.begin();
    const { ref } = this.route;
    this.problem = "";
    const problem = await this.speak(talk, ref).catch((error) => `Talking has failed: ${error.message}`);
    if (this.talking === talk && problem) this.silence(problem);
    if (this.talking) return;
    this.voice.microphone?.close(); // it was released, perhaps to answer the browser's question
    if (problem && this.route.ref === ref) this.problem = problem;
    this.changed();
  }

  /** @param {{number: number}} talk @param {string} ref @returns {Promise<string>} why it cannot begin; "" it has, or has ended */
  async speak(talk, ref) {
    const { voice } = this;
    const context = this.speaker.start();
    this.adjust();
    if (!this.link.worker) this.connect(ref, null);
    clearInterval(voice.timer);
    voice.timer = setInterval(() => this.step(), STEP_MS);
    this.changed();
    const microphone = (voice.microphone ??= new Microphone(context));
    const problem = await microphone.open();
    if (problem || this.talking !== talk) return problem;
    const { port1, port2 } = new MessageChannel();
    microphone.attach(port2);
    this.link.send({ op: "talk", talk: talk.number, rate: context.sampleRate, port: port1 }, [port1]);
    return "";
  }

  /** While a talk lasts: its worker ends it unless the page shows that it runs; a dialog ends it, too. */
  step() {
    if (!this.talking && performance.now() - this.voice.endedAt > KEEP_MS) {
      clearInterval(this.voice.timer);
      if (!this.listening) this.leave();
    } else if (this.talking && document.querySelector("dialog[open]")) this.silence();
    else if (this.talking) this.link.send({ op: "alive" });
  }

  /** What ends a gesture ends a talk; where the page is hidden, or frozen, no timer would close the microphone. */
  interrupt() {
    this.voice.held = false;
    this.silence();
    this.voice.microphone?.close();
  }

  /** End the talk. @param {string} [why] if the person did not */
  silence(why = "") {
    if (!this.talking) return;
    this.voice.end();
    if (why && why !== this.talkReason()) this.problem = why; // a reason that lasts is beside the button
    this.link.send({ op: "end" });
    this.adjust();
    this.changed();
  }

  // -- both

  /** The page leaves this component, or stops listening. */
  leave() {
    this.silence();
    clearInterval(this.voice.timer);
    this.voice.microphone?.close();
    this.listening = false;
    this.link.close();
    this.speaker.context?.suspend();
    this.changed();
  }

  /** Nothing is heard while a person talks: it would come back by the microphone. */
  adjust() {
    this.speaker.mute(this.muted || this.talking !== null);
  }

  /** @param {string} ref @param {MessagePort|null} port where sound is played; null: this is only for talking */
  connect(ref, port) {
    const name = this.connection.you?.user ?? "";
    const of = { ref, name, port, rate: this.speaker.context?.sampleRate };
    this.link.open(of, (message) => this.take(message), (why) => {
      this.leave();
      this.problem = `Sound has failed: ${why}. Try again`;
      this.changed();
    });
  }

  /** @param {any} message of the worker */
  take({ stats, connection, answer }) {
    if (stats) this.link.stats = stats;
    if (connection) this.link.isOpen = connection === "open";
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
    const why = whyNotReached(this);
    if (why) return why;
    const { ref } = this.route;
    const offers = new Offers(ref, this.store.get(ref, "capabilities")?.value);
    if (!offers.has("audio")) return `${nameIn(this.store, ref)} has no sound`;
    return browser.find("AudioWorkletNode") ? "" : "Needs https";
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
    const own = talker === this.connection.you?.user && performance.now() - this.voice.endedAt < OWN_MS;
    return this.talking || own ? "" : talker;
  }
}

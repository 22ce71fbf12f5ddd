// One component's recording, opened: the server's player feeds what the page of a live robot is made of.

import { Archive } from "../../core/replay/archive.js";
import { Feed, SPEEDS } from "../../core/replay/feed.js";
import { dayOf, firstOf, startOf, stretchOf } from "../../core/replay/timeline.js";
import { LogBook } from "../../core/logs.js";
import { Store } from "../../core/store.js";
import { ReplayPictures } from "../../media/replay/pictures.js";
import { recordingsOf } from "../fleet/recordings-link.js";
import { logViewOf } from "../parts/log-view.js";
import { Model } from "../parts/models.js";
import { recorderOf } from "../parts/recorder.js";
import { span } from "../parts/words.js";
import { Video } from "../robot/video-model.js";
import { Sound } from "../robot/sound-model.js";

const ADDRESS_MS = 400; // browsers limit how often it may change
const LOADING_MS = 400; // a seek that takes longer is shown
const OLD_MS = 2000; // as of a live picture

/** The connection of a recording: always there, and nothing is sent by it. @param {any} live where notices are shown */
const recorded = (live) => ({
  isOpen: true,
  state: "open",
  you: null,
  socket: { outdated: false },
  answers: new Map(),
  onLogs: null,
  get words() {
    return live.words;
  },
  onChange: () => () => {},
  may: () => false,
  show: (words) => live.show(words),
});

/** The picture of a recording: it is always of the same component. */
class RecordedVideo extends Video {
  show() {}
}

/** The sound of a recording: as a live robot's, but the server's player sends it by another socket. */
class ReplaySound extends Sound {
  /** @param {any} page the services of the replay @param {string} ref */
  constructor({ store, connection }, ref) {
    super({ store, connection, route: { ref, onChange() {} } });
  }

  /** The worker opens no socket of its own. @param {string} _ref @param {MessagePort | null} port */
  connect(_ref, port) {
    super.connect("", port);
  }

  /** @param {Uint8Array} payload */
  feed(payload) {
    if (this.listening) this.link.send({ op: "take", payload: payload.slice().buffer });
  }

  /** A seek: what waits at the loudspeaker is not played. */
  restart() {
    if (!this.link.worker || !this.listening) return;
    const { port1, port2 } = new MessageChannel();
    this.speaker.attach(port2);
    this.connect("", port1);
  }

  talkReason() {
    return "This is a recording";
  }
}

/** @param {string} ref */
const inertDriver = (ref) => ({
  ref,
  onChange: () => () => {},
  interrupt() {},
  changed() {},
  fail() {},
  reason: () => ({ code: "replay", text: "This is a recording" }),
});

/** One day of a recording: what it holds, once the server has indexed it. */
export class Day extends Model {
  /** @param {string} ref */
  constructor(ref) {
    super();
    this.ref = ref;
    this.archive = new Archive();
    this.name = ""; // 2026-11-22
    /** @type {import("../../core/replay/archive.js").Timeline | null} */
    this.timeline = null;
    this.indexing = -1; // share; -1: it is not
    this.openedAt = 0; // of performance.now()
    this.problem = "";
    this.then = () => {}; // once the timeline is here
    this.abort = new AbortController();
  }

  /** @param {string} name @param {() => void} [then] @param {boolean} [again] after a failure */
  async open(name, then = () => {}, again = false) {
    if (name === this.name && !this.problem) return;
    this.abort.abort();
    const { signal } = (this.abort = new AbortController());
    Object.assign(this, { name, then, timeline: null, indexing: -1, openedAt: performance.now(), problem: "" });
    this.changed();
    const index = (share) => {
      this.indexing = share;
      this.changed();
    };
    try {
      this.timeline = await this.archive.timeline(name, this.ref, index, signal, again);
      then();
    } catch (error) {
      if (signal.aborted) return;
      this.problem = /** @type {Error} */ (error).message;
    }
    index(-1);
  }

  get sessions() {
    return this.timeline?.sessions ?? [];
  }

  /** @returns {Promise<string>} the newest one; "": there is none, see ``problem`` */
  async newest() {
    let day;
    try {
      day = (await this.archive.days(this.abort.signal)).find(({ robots }) => robots.includes(this.ref));
      this.problem = day ? "" : `There is no recording of ${this.ref}`;
    } catch (error) {
      this.problem = /** @type {Error} */ (error).message;
    }
    this.changed();
    return day?.day ?? "";
  }
}

export class Replay extends Model {
  /** @param {any} live the page's services @param {string} ref */
  constructor(live, ref) {
    super();
    this.ref = ref;
    this.feed = new Feed(ref, {
      begin: () => this.begin(),
      take: (message) => this.take(message),
      picture: (...picture) => this.pictures.feed(...picture),
      sound: (payload) => this.sound.feed(payload),
      changed: () => this.follow(),
    });
    this.store = new Store(() => this.feed.position);
    this.store.offset = 0; // its clock is the time of the recording
    this.isOutdated = false; // what the store has is of before a seek
    this.isHere = false; // the first state is
    this.video = new RecordedVideo(this.store);
    this.video.ref = ref;
    this.pictures = new ReplayPictures((bitmap, info) => this.video.draw(bitmap, info), () => this.changed());
    this.day = new Day(ref);
    this.day.onChange(() => this.changed());
    /** What a person has marked for a download. @type {{since?: number, until?: number}} */
    this.marked = {};
    /** What widgets get instead of the page's own services. */
    this.page = {
      ...live,
      recording: this,
      store: this.store,
      connection: recorded(live.connection),
      video: this.video,
      driver: inertDriver(ref),
      commands: { readLogs: () => 0, stop: (of) => of === "" && live.commands.stop("") },
      estop: null,
    };
    this.sound = new ReplaySound(this.page, ref);
    this.page.sound = { model: this.sound };
    this.addressTimer = 0;
  }

  close() {
    clearTimeout(this.addressTimer);
    this.day.abort.abort();
    this.feed.close();
    this.pictures.stop();
    this.sound.leave();
    this.sound.speaker.context?.close();
    this.store.clear();
    this.video.canvas.remove();
    this.video.canvas.width = this.video.canvas.height = 0; // gives its memory back at once
  }

  // -- what people do

  /** Go where the address says: ?at=MS, else ?day=2026-11-22, else the newest day. */
  async start() {
    const query = new URLSearchParams(location.search);
    const at = Number(query.get("at") || NaN);
    if (Number.isFinite(at)) return this.seek(at);
    const asked = query.get("day") ?? "";
    const day = Number.isFinite(startOf(asked)) ? asked : await this.day.newest();
    if (day) this.day.open(day, () => this.feed.seeks || this.seek(firstOf(this.day, !asked)));
  }

  /** @param {number} ms */
  seek(ms) {
    if (!Number.isFinite(ms)) return;
    this.day.open(dayOf(ms));
    this.feed.seek(ms);
  }

  /** The first session of another day. @param {string} name */
  openDay(name) {
    this.feed.play(false); // else its own day would be opened again
    this.day.open(name, () => this.feed.seek(firstOf(this.day)));
  }

  /** @param {number} ms from where it is */
  step(ms) {
    this.seek(this.feed.position + ms);
  }

  toggle() {
    this.feed.play(!this.feed.played.on);
  }

  /** @param {1 | -1} steps */
  faster(steps) {
    this.feed.setSpeed(SPEEDS[SPEEDS.indexOf(this.feed.played.speed) + steps]);
  }

  /** Mark where a download begins or ends; what is before its begin ends nothing. @param {{since?: number, until?: number}} marks */
  mark(marks) {
    const { since = -Infinity, until = Infinity } = { ...this.marked, ...marks };
    this.marked = since < until ? { ...this.marked, ...marks } : marks;
    this.changed();
  }

  unmark() {
    this.marked = {};
    this.changed();
  }

  /** What is downloaded. */
  get stretch() {
    const { since = null, until = null } = this.marked;
    return stretchOf(since, until, this.day.sessions, this.feed.position);
  }

  // -- what the player sends

  /** A seek has arrived: everything begins anew. */
  begin() {
    this.isOutdated = true;
    this.video.forget();
    this.pictures.begin();
    this.sound.restart();
  }

  take(message) {
    if (message.op === "logs") return logViewOf(this.store, this.ref).take(message);
    if (this.isOutdated) this.forget(); // the first state has all that there is
    for (const [ref, metric, value, age] of message.set) {
      if (value === null) this.store.drop(ref, metric);
      else this.store.set(ref, metric, value, age);
    }
    return undefined;
  }

  forget() {
    this.isOutdated = false;
    this.isHere = true;
    this.store.clear();
    recorderOf(this.page, this.ref).restart();
    logViewOf(this.store, this.ref).book = new LogBook();
  }

  /** Seeks and pauses are in the address; playing leads to the next day. */
  follow() {
    const { position, played } = this.feed;
    this.sound.problem = played.speed === 1 ? "" : "Sound is played at speed ×1 only";
    if (played.on && dayOf(position) !== this.day.name) this.day.open(dayOf(position));
    this.changed();
    clearTimeout(this.addressTimer);
    this.addressTimer = setTimeout(() => {
      const path = `${recordingsOf(this.ref)}?at=${Math.round(position)}`;
      if (location.pathname + location.search !== path) history.replaceState(null, "", path);
    }, ADDRESS_MS);
  }

  // -- of the picture

  /** Why there is no picture of this time; "" there is. */
  get cover() {
    const { feed, pictures, video } = this;
    if (feed.problem) return feed.problem;
    if (feed.seeking) return performance.now() - feed.soughtAt > LOADING_MS ? "Loading…" : "";
    if (!video.info) return pictures.state.problem || "No picture was recorded here";
    const old = feed.position - video.info.receivedMs;
    return old > OLD_MS ? `No picture was recorded here · this one is ${span(old)} older` : pictures.state.problem;
  }
}

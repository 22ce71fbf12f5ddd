// One component's recordings, opened: the player, and everything of the page that shows what it plays.

import { Archive } from "../../core/replay/archive.js";
import { CHAIN, INCOMING, PICTURE, SOUND, STATE } from "../../core/replay/frames.js";
import { Incoming } from "../../core/replay/incoming.js";
import { Heartbeats } from "../../core/replay/liveness.js";
import { Player, SPEEDS } from "../../core/replay/player.js";
import { View, dayOf, extentOf, stretchOf } from "../../core/replay/timeline.js";
import { Store } from "../../core/store.js";
import { ReplayPictures } from "../../media/replay/pictures.js";
import { ReplaySound } from "../../media/replay/sound.js";
import { LogBook } from "../../core/logs.js";
import { logViewOf } from "../parts/log-view.js";
import { Model } from "../parts/models.js";
import { recordingsOf } from "../fleet/recordings-link.js";
import { recorderOf } from "../parts/recorder.js";
import { Video } from "../robot/video-model.js";

const TICK_MS = 20;
const LIVENESS_MS = 500;
const END_MS = 2000; // before the last message
const ADDRESS_MS = 400; // browsers limit how often it may change
const PICTURE_WITHIN_MS = 10_000; // a picture that was asked for and is not loaded by then is not shown
const text = new TextDecoder();

/** The connection of a recording: always there, and nothing is sent by it. */
class Recorded extends Model {
  /** @param {any} live where notices are shown */
  constructor(live) {
    super();
    this.live = live;
    this.isOpen = true;
    this.state = "open";
    this.you = null;
    this.answers = new Map();
    /** @type {any} */
    this.onLogs = null;
  }

  may() {
    return false;
  }

  show(words) {
    this.live.show(words);
  }
}

/** @param {string} ref */
const inertDriver = (ref) => ({
  ref,
  onChange: () => () => {},
  interrupt() {},
  changed() {},
  reason: () => ({ code: "replay", text: "This is a recording" }),
});

export class Replay extends Model {
  /** @param {any} page the live one's services @param {string} ref */
  constructor(page, ref) {
    super();
    this.ref = ref;
    this.archive = new Archive();
    this.player = new Player({
      load: (at, lasts, seek, signal) => this.archive.segment(ref, at, lasts, seek, signal),
      deliver: (frames) => this.take(frames),
      reset: () => this.forget(),
      changed: () => this.follow(),
      busy: () => this.pictures.busy,
      soundLead: () => this.sound.lead,
    });
    this.store = new Store(() => this.player.position);
    this.store.offset = 0; // its clock is the time of the recording
    this.video = new Video(this.store);
    this.video.ref = ref;
    this.pictures = new ReplayPictures((bitmap, info) => this.draw(bitmap, info), () => this.changed());
    this.sound = new ReplaySound(() => this.changed());
    this.incoming = new Incoming();
    this.heartbeats = new Heartbeats();
    /** @type {any} for tests: the last picture that was drawn */
    this.drawnAt = null;
    this.logs = 0;
    this.shownAt = -Infinity;
    /** @type {number | null} */
    this.markIn = null;
    /** @type {number | null} */
    this.markOut = null;
    // -- the day
    this.day = "";
    this.view = new View(dayOf(Date.now()));
    /** @type {import("../../core/replay/archive.js").Timeline | null} */
    this.timeline = null;
    this.indexing = -1; // share; -1: it is not
    this.dayProblem = "";
    this.then = () => {}; // once the timeline is here
    this.start = () => {}; // choose a day
    this.wantedAt = -Infinity; // when the next picture was asked for, by the page's clock; -Infinity: it was not
    this.dayAbort = new AbortController();
    this.connection = new Recorded(page.connection);
    /** What widgets get instead of the page's own services. */
    this.page = {
      ...page,
      store: this.store,
      connection: this.connection,
      video: this.video,
      driver: inertDriver(ref),
      commands: { askSeries: () => 0, readLogs: () => 0 },
      sound: null,
      estop: null,
    };
    this.timers = [setInterval(() => this.tick(), TICK_MS), setInterval(() => this.shareLiveness(), LIVENESS_MS)];
    this.addressTimer = 0;
    this.closed = false;
    this.speed = 1;
  }

  close() {
    this.closed = true;
    this.timers.forEach(clearInterval);
    clearTimeout(this.addressTimer);
    this.dayAbort.abort();
    this.player.close();
    this.pictures.close();
    this.sound.close();
    this.store.clear();
    this.video.canvas.remove();
    this.video.canvas.width = this.video.canvas.height = 0; // gives its memory back at once
  }

  // -- what people do

  /** @param {number} ms */
  seek(ms) {
    if (!Number.isFinite(ms) || this.closed) return;
    this.wantedAt = -Infinity;
    this.openDay(dayOf(ms));
    this.player.seek(ms);
  }

  /** @param {number} ms from where it is */
  step(ms) {
    this.seek(this.player.position + ms);
  }

  /** To where a picture is: to the first one from there on, if there is none of before. @param {number} ms */
  seekPicture(ms) {
    this.seek(ms);
    this.wantedAt = performance.now();
  }

  /** One picture on or back. @param {1 | -1} way */
  stepPicture(way) {
    this.player.pause();
    if (way > 0) {
      this.wantedAt = performance.now();
      this.goToPicture();
    } else if (this.video.info) this.seek(this.video.info.receivedMs - 1);
  }

  /** The picture that was asked for, once it is loaded. */
  goToPicture() {
    if (this.wantedAt === -Infinity || this.player.seeking) return;
    const next = this.player.nextPicture;
    if (next) this.player.go(next.at);
    const { complete, playing } = this.player;
    if (next || complete || playing || performance.now() - this.wantedAt > PICTURE_WITHIN_MS) this.wantedAt = -Infinity;
  }

  /** @param {1 | -1} steps */
  faster(steps) {
    const index = SPEEDS.indexOf(this.player.speed) + steps;
    if (SPEEDS[index]) this.player.setSpeed(SPEEDS[index]);
  }

  /** The end of what was recorded that day. */
  get last() {
    if (!this.timeline) return NaN;
    const { from, step, activity } = this.timeline;
    return from + step * (activity.findLastIndex((bits) => bits !== 0) + 1) - END_MS;
  }

  toggle() {
    if (this.player.playing) this.player.pause();
    else this.player.play();
  }

  /** @param {"markIn" | "markOut"} name @param {number | null} at */
  mark(name, at) {
    this[name] = at;
    if (this.markIn !== null && this.markOut !== null && this.markIn >= this.markOut) {
      if (name === "markIn") this.markOut = null;
      else this.markIn = null;
    }
    this.changed();
  }

  /** What is downloaded. */
  get stretch() {
    return stretchOf(this.markIn, this.markOut, this.timeline?.sessions ?? [], this.player.position);
  }

  /** The same, once a person has marked it. */
  get marked() {
    return this.markIn === null && this.markOut === null ? null : this.stretch;
  }

  /** After what is in dayProblem. */
  tryAgain() {
    if (this.day) return this.openDay(this.day, this.then, true);
    this.dayProblem = "";
    this.changed();
    return this.start();
  }

  /** @param {string} day @param {() => void} [then] once its timeline is here @param {boolean} [again] after a failure */
  async openDay(day, then = () => {}, again = false) {
    if (this.closed || (day === this.day && !this.dayProblem)) return;
    this.dayAbort.abort();
    const { signal } = (this.dayAbort = new AbortController());
    if (day !== this.day) this.view = new View(day);
    this.day = day;
    this.then = then;
    this.timeline = null;
    this.indexing = -1;
    this.dayProblem = "";
    this.changed();
    try {
      this.timeline = await this.archive.timeline(day, this.ref, (share) => this.index(share), signal, again);
      this.view.show(...extentOf(this.timeline, this.view));
      then();
    } catch (error) {
      if (signal.aborted) return;
      this.dayProblem = /** @type {Error} */ (error).message;
    }
    this.indexing = -1;
    this.changed();
  }

  /** @param {number} share */
  index(share) {
    this.indexing = share;
    this.changed();
  }

  // -- what the player does

  tick() {
    this.player.tick();
    this.goToPicture();
    const { position, playing } = this.player;
    this.sound.run(playing && this.player.speed === 1 && !this.player.waiting);
    if (this.player.speed !== this.speed) {
      this.speed = this.player.speed;
      this.sound.reset();
    }
    if (playing && dayOf(position) !== this.day) this.openDay(dayOf(position));
  }

  /** Its state has changed: seeks and pauses are in the address. */
  follow() {
    this.changed();
    clearTimeout(this.addressTimer);
    this.addressTimer = setTimeout(() => {
      const path = `${recordingsOf(this.ref)}?at=${Math.round(this.player.position)}`;
      if (location.pathname + location.search !== path) history.replaceState(null, "", path);
    }, ADDRESS_MS);
  }

  /** A seek has arrived: everything begins anew. */
  forget() {
    this.store.clear();
    this.video.forget();
    this.pictures.reset();
    this.sound.reset();
    this.incoming.clear();
    this.heartbeats = new Heartbeats();
    recorderOf(this.page, this.ref).restart();
    logViewOf(this.store, this.ref).book = new LogBook();
    this.logs = 0;
  }

  /** @param {import("../../core/replay/frames.js").Frame[]} frames that are due */
  take(frames) {
    const pictures = [];
    const lines = [];
    for (const frame of frames) {
      if (frame.flags & INCOMING) this.takeIncoming(frame);
      else if (frame.flags & PICTURE) pictures.push(frame);
      else if (frame.flags & SOUND) this.sound.take(frame);
      else if (frame.flags & CHAIN) continue; // neither a picture nor a sound: nothing builds on it
      else this.takeValue(frame, lines);
    }
    if (pictures.length) this.pictures.take(pictures);
    if (lines.length) this.takeLines(lines);
  }

  /** @param {import("../../core/replay/frames.js").Frame} frame */
  takeIncoming({ at, metric, payload, flags }) {
    const value = flags & (PICTURE | SOUND) ? undefined : parsed(payload);
    if (!(flags & STATE)) this.incoming.take(at, metric, value, payload.length);
  }

  /** @param {import("../../core/replay/frames.js").Frame} frame @param {unknown[]} lines of logs */
  takeValue({ at, metric, payload }, lines) {
    const value = payload.length ? parsed(payload) : undefined;
    if (metric === "link") this.heartbeats.receiveLink(value);
    if (!payload.length) return this.store.drop(this.ref, metric); // nothing is retained any more
    if (value === undefined) return undefined;
    if (metric === "logs") lines.push(value);
    this.store.set(this.ref, metric, value, this.player.position - at);
    if (metric !== "online") return undefined;
    this.heartbeats.receive(at, value);
    return this.shareLiveness();
  }

  /** @param {unknown[]} lines */
  takeLines(lines) {
    const first = this.logs + 1;
    this.logs += lines.length;
    logViewOf(this.store, this.ref).take({ ref: this.ref, origin: "recording", first, lines });
  }

  /** What the server tells of a live component. */
  shareLiveness() {
    if (this.heartbeats.receivedAt === -Infinity) return;
    const view = this.heartbeats.view(this.player.position);
    const old = this.store.get(this.ref, "web/liveness")?.value;
    const now = performance.now();
    if (old && old.online === view.online && now - this.shownAt < LIVENESS_MS) return;
    this.shownAt = now;
    this.store.set(this.ref, "web/liveness", view);
  }

  /** @param {ImageBitmap} bitmap @param {import("../../media/replay/pictures.js").RecordedInfo} info */
  draw(bitmap, info) {
    this.video.draw(bitmap, info);
    this.sound.drew(info.receivedMs, info.capturedMs);
    const { capturedMs, receivedMs } = info;
    this.drawnAt = { time: this.player.position, capturedMs, receivedMs, now: performance.now(), seeks: this.player.seeks };
  }
}

/** @param {Uint8Array} payload @returns {unknown} undefined: it is no JSON */
function parsed(payload) {
  try {
    return JSON.parse(text.decode(payload));
  } catch {
    return undefined;
  }
}

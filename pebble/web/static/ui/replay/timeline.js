// The day on a canvas: what was going on, what is missing, and where the replay is.

import * as browser from "../../core/browser.js";
import { ROWS, columns, holding } from "../../core/replay/timeline.js";
import { html, useEffect, useModel, useRef, useState, useTick } from "../parts/hooks.js";
import { shortTime } from "../parts/more-words.js";
import { clockTime } from "../parts/words.js";
import { dayWords } from "./choose.js";
import { long } from "./picture.js";

const AXIS = 20;
const SESSIONS = 12;
const ROW = 13;
const GAP = 3;
const HEIGHT = AXIS + SESSIONS + GAP + ROWS.length * (ROW + GAP);
const TICK_PX = 76;
const STEP_MS = 50; // between two looks whether it has to be drawn again
const CLICK_PX = 5;
const ZOOM = 1.6;

export function TimelineCard({ replay }) {
  useModel(replay);
  useTick(500);
  const { timeline, indexing, dayProblem, player, view } = replay;
  const canvas = useRef(null);
  const box = useRef(/** @type {Drawing | null} */ (null));
  const [hover, setHover] = useState(/** @type {{x: number, at: number} | null} */ (null));
  const [shown, setShown] = useState("");
  useEffect(() => {
    if (!canvas.current) return undefined;
    const drawing = (box.current = new Drawing(canvas.current, replay, setHover, setShown));
    return () => drawing.close();
  }, [replay]);
  const act = (fn) => () => {
    fn(replay.view);
    box.current?.touched();
  };
  const middle = Math.min(view.to, Math.max(view.from, player.position));
  return html`<section class="card timeline" aria-label="Timeline of the day">
    <div class="timeline-head">
      <p data-test="timeline-range"><b>${dayWords(view.start)}</b> <span class="dim">${shown}</span></p>
      <div class="timeline-tools" role="group" aria-label="What part of the day">
        <button type="button" data-test="zoom-out" aria-label="Show more time" onClick=${act((one) => one.zoom(1 / ZOOM, middle))}>−</button>
        <button type="button" data-test="zoom-in" aria-label="Show less time" onClick=${act((one) => one.zoom(ZOOM, middle))}>+</button>
        <button type="button" data-test="zoom-day" onClick=${act((one) => one.show(one.start, Infinity))}>Day</button>
        <button type="button" class="turned-left" aria-label="Earlier" onClick=${act((one) => one.move(-one.span / 2))}>←</button>
        <button type="button" aria-label="Later" onClick=${act((one) => one.move(one.span / 2))}>→</button>
      </div>
    </div>
    <div class="timeline-grid">
      <ul class="timeline-rows" aria-hidden="true">
        <li class="timeline-used">Used</li>
        ${ROWS.map(({ id, title }) => html`<li key=${id} class=${`row-${id}`}>${title}</li>`)}
      </ul>
      <div class="timeline-place">
        <canvas
          ref=${canvas}
          class="timeline-canvas"
          data-test="timeline"
          role="slider"
          tabindex="0"
          aria-label="Time of the recording; arrow keys move it by ten seconds, with Shift by a minute"
          aria-valuemin="0"
          aria-valuemax="86400"
          aria-valuenow=${Math.max(0, Math.min(86_400, Math.round((player.position - view.start) / 1000) || 0))}
          aria-valuetext=${player.seeks ? clockTime(player.position) : "none yet"}
        ></canvas>
        <div class="playhead" hidden></div>
        ${hover && html`<${Hover} replay=${replay} ...${hover} />`}
        ${!timeline && html`<div class="timeline-cover" role="status">
          <p>${coverWords(indexing, dayProblem)}</p>
          ${dayProblem && html`<button type="button" data-test="try-again" onClick=${() => replay.tryAgain()}>Try again</button>`}
        </div>`}
      </div>
    </div>
    <${Legend} timeline=${timeline} />
  </section>`;
}

function coverWords(indexing, problem) {
  if (problem) return `✖ ${problem}`;
  return indexing < 0 ? "Loading the day…" : `This day is being indexed: ${Math.round(100 * indexing)} %`;
}

function Legend({ timeline }) {
  const gaps = timeline?.gaps.length ?? 0;
  const outages = timeline?.outages.length ?? 0;
  return html`<ul class="legend">
    <li><i class="legend-mark gap"></i>not recorded${gaps > 0 && ` (${gaps})`}</li>
    <li><i class="legend-mark outage"></i>robot silent${outages > 0 && ` (${outages})`}</li>
    <li><i class="legend-mark used"></i>used</li>
    <li><i class="legend-mark marked"></i>marked</li>
    <li class="dim legend-help">Click: go there · drag: move · wheel: zoom · Space: play</li>
  </ul>`;
}

/** What was there. */
function Hover({ replay, x, at }) {
  const { timeline } = replay;
  const gap = holding(timeline?.gaps ?? [], at);
  const place = useRef(null);
  useEffect(() => {
    const { offsetWidth, parentElement } = place.current;
    const left = Math.min(parentElement.clientWidth - offsetWidth, Math.max(0, x - offsetWidth / 2));
    place.current.style.transform = `translateX(${left}px)`;
  });
  return html`<div class="timeline-hover" ref=${place} data-test="hover">
    <b>${clockTime(at)}</b>${gap && html`<span>not recorded: ${gap.why || "no reason is known"}</span>`}
  </div>`;
}

/** The canvas, and how it is moved: by mouse, wheel and fingers. */
class Drawing {
  /** @param {HTMLCanvasElement} canvas @param {any} replay @param {(hover: any) => void} onHover @param {(words: string) => void} onShown */
  constructor(canvas, replay, onHover, onShown) {
    this.canvas = canvas;
    this.replay = replay;
    this.onHover = onHover;
    this.onShown = onShown;
    this.head = /** @type {HTMLElement} */ (canvas.parentElement?.querySelector(".playhead"));
    this.drawn = "";
    this.follows = true; // the playhead stays in sight
    /** @type {Map<number, {x: number, y: number}>} */
    this.pointers = new Map();
    this.moved = 0;
    this.abort = new AbortController();
    this.listen();
    this.timer = setInterval(() => document.hidden || this.draw(), STEP_MS);
    this.draw();
  }

  close() {
    clearInterval(this.timer);
    this.abort.abort();
  }

  /** A person has chosen what is seen. */
  touched() {
    const { view, player } = this.replay;
    this.follows = player.position >= view.from && player.position < view.to;
    this.draw();
  }

  get width() {
    return Math.max(1, this.canvas.clientWidth);
  }

  /** @param {PointerEvent | WheelEvent} event */
  x(event) {
    return event.clientX - this.canvas.getBoundingClientRect().left;
  }

  listen() {
    const on = (name, fn) => this.canvas.addEventListener(name, fn, { passive: false, signal: this.abort.signal });
    on("wheel", (event) => {
      event.preventDefault();
      const { view } = this.replay;
      const sideways = event.shiftKey ? event.deltaY : event.deltaX;
      if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) view.move((sideways / this.width) * view.span);
      else view.zoom(2 ** (-event.deltaY / 200), view.at(this.x(event), this.width));
      this.touched();
    });
    on("pointerdown", (event) => {
      if (event.button) return;
      browser.capture(event);
      if (!this.pointers.size) this.moved = 0;
      this.pointers.set(event.pointerId, { x: this.x(event), y: event.clientY });
    });
    on("pointermove", (event) => this.move(event));
    on("pointerup", (event) => {
      const known = this.pointers.delete(event.pointerId);
      if (known && !this.pointers.size && this.moved < CLICK_PX) this.replay.seek(this.replay.view.at(this.x(event), this.width));
      if (known && event.pointerType !== "mouse") this.onHover(null);
    });
    on("pointercancel", (event) => this.pointers.delete(event.pointerId));
    on("pointerleave", () => this.onHover(null));
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId);
    const { view } = this.replay;
    const x = this.x(event);
    if (!before) {
      if (event.pointerType === "mouse") this.onHover({ x, at: view.at(x, this.width) });
      return;
    }
    this.onHover(null);
    const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
    this.moved += Math.abs(x - before.x);
    if (other) {
      const middle = (x + other.x) / 2;
      view.zoom(Math.max(1, Math.abs(x - other.x)) / Math.max(1, Math.abs(before.x - other.x)), view.at(middle, this.width));
      this.moved += CLICK_PX;
    }
    if (this.moved >= CLICK_PX) view.move((((before.x - x) / (other ? 2 : 1)) / this.width) * view.span);
    this.pointers.set(event.pointerId, { x, y: event.clientY });
    this.touched();
  }

  draw() {
    const { replay, canvas, width } = this;
    const { view, player, timeline, marked } = replay;
    if (player.playing && this.follows && player.seeks) view.follow(player.position);
    const inside = player.position >= view.from && player.position < view.to;
    if (inside) this.follows = true;
    this.head.hidden = !inside || !player.seeks;
    this.head.style.transform = `translateX(${view.x(player.position, width).toFixed(1)}px)`;
    const pixels = devicePixelRatio || 1;
    const style = getComputedStyle(canvas);
    const names = ["--fg", "--dim", "--line", "--sunk", "--accent", "--accent-soft", "--bad", "--warn-soft", ...ROWS.map(({ id }) => `--row-${id}`)];
    const colours = Object.fromEntries(names.map((name) => [name.slice(2), style.getPropertyValue(name).trim()]));
    const key = JSON.stringify([view.from, view.to, width, pixels, colours, marked, timeline?.activity.length, replay.day]);
    if (key === this.drawn) return;
    this.drawn = key;
    this.onShown(rangeWords(view));
    canvas.dataset.from = String(view.from); // for tests
    canvas.dataset.to = String(view.to);
    Object.assign(canvas, { width: Math.round(width * pixels), height: Math.round(HEIGHT * pixels) });
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    context.scale(pixels, pixels);
    new Painter(context, view, width, colours).paint(timeline, marked);
  }
}

const rangeWords = (view) => `${shortTime(view.from)} – ${shortTime(view.to)} (${long(view.span)})`;

/** One drawing of the day. */
class Painter {
  /** @param {CanvasRenderingContext2D} context @param {any} view @param {number} width @param {Record<string, string>} colours */
  constructor(context, view, width, colours) {
    this.context = context;
    this.view = view;
    this.width = width;
    this.colours = colours;
  }

  paint(timeline, marked) {
    const { colours } = this;
    if (marked) this.area(marked.since, marked.until, colours["warn-soft"], AXIS, HEIGHT);
    this.axis();
    if (!timeline) return;
    for (const { since, until } of timeline.sessions) this.area(since, until, colours.accent, AXIS, AXIS + SESSIONS - 2);
    const bits = columns(timeline, this.view, Math.ceil(this.width));
    ROWS.forEach(({ bit, id }, index) => this.row(bits, bit, colours[`row-${id}`], rowTop(index)));
    for (const { since, until } of timeline.outages) this.hatch(since, until, colours.dim, 9, rowTop(0), rowTop(0) + ROW);
    for (const { since, until } of timeline.gaps) this.hatch(since, until, colours.bad, 6, AXIS, HEIGHT);
  }

  axis() {
    const { context, view, width, colours } = this;
    const offset = -60_000 * new Date(view.from).getTimezoneOffset();
    context.font = "12px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const { at, step } of view.ticks(width, TICK_PX, offset)) {
      const x = Math.round(view.x(at, width)) + 0.5;
      context.fillStyle = colours.line;
      context.fillRect(x - 0.5, AXIS - 4, 1, HEIGHT - AXIS + 4);
      const words = step < 60_000 ? clockTime(at) : shortTime(at);
      const half = context.measureText(words).width / 2;
      context.fillStyle = colours.dim;
      context.textAlign = "center";
      if (x - half >= 0 && x + half <= width) context.fillText(words, x, 8);
    }
    ROWS.forEach((_, index) => {
      context.fillStyle = colours.sunk;
      context.fillRect(0, rowTop(index), width, ROW);
    });
  }

  area(since, until, colour, top, bottom) {
    const [from, to] = this.pixels(since, until);
    if (to < from) return;
    this.context.fillStyle = colour;
    this.context.fillRect(from, top, to - from, bottom - top);
  }

  /** @returns {[number, number]} at least two pixels wide; the second is less if nothing of it is seen */
  pixels(since, until) {
    const { view, width } = this;
    if (until < view.from || since > view.to) return [0, -1];
    const from = Math.max(0, view.x(since, width));
    return [from, Math.min(width, Math.max(from + 2, view.x(until, width)))];
  }

  row(bits, bit, colour, top) {
    const { context } = this;
    context.fillStyle = colour;
    for (let x = 0; x < bits.length; ) {
      let end = x;
      while (end < bits.length && bits[end] & bit) end++;
      if (end > x) context.fillRect(x, top, end - x, ROW);
      x = Math.max(end, x + 1);
    }
  }

  hatch(since, until, colour, apart, top, bottom) {
    const [from, to] = this.pixels(since, until);
    if (to < from) return;
    const { context, colours } = this;
    context.save();
    context.beginPath();
    context.rect(from, top, to - from, bottom - top);
    context.clip();
    context.fillStyle = colours.sunk;
    context.globalAlpha = 0.6;
    context.fillRect(from, top, to - from, bottom - top);
    context.globalAlpha = 1;
    context.strokeStyle = colour;
    context.lineWidth = 1.2;
    context.beginPath();
    const height = bottom - top;
    for (let x = from - height; x < to; x += apart) {
      context.moveTo(x, bottom);
      context.lineTo(x + height, top);
    }
    context.stroke();
    context.restore();
  }
}

const rowTop = (index) => AXIS + SESSIONS + GAP + index * (ROW + GAP);

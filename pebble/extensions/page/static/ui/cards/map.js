// Where a component was and is, by its odometry: a trail over a grid.

import * as browser from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { scriptName } from "../../core/reasons.js";
import { differs, pieces, poseOf, poseWords } from "../../core/trail.js";
import { html, useEffect, useMetrics, useOnline, usePage, useRef, useState, useTick, useValue } from "../parts/hooks.js";
import { Nothing } from "../parts/nothing.js";
import { Button, Gone, Icon, Select, Why, isGone, useEnded } from "../parts/parts.js";
import { plain } from "../parts/more-words.js";
import { recorderOf } from "../parts/recorder.js";
import { useReasons } from "../parts/why-not.js";
import { whyNotStarted } from "./autonomy-model.js";

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const ARROW_PX = 24;

const LIMITS = { spanMs: 3_600_000, most: 4000, differs };
const SOURCES = { "wheel-odometry": "By its wheels", "localization-pose": "In its map" };
const STEP_MS = 100; // between two drawings
const WORDS_MS = 500;
const ZOOM = { start: 120, least: 2, most: 1200 }; // pixels per metre
const GRIDS = [0.5, 1, 5, 10, 50, 100, 500]; // metres
const GRID_PIXELS = 24; // lines are not nearer

/** Why the position of a robot with working scripts stays where it is. */
const NO_SAMPLES =
  "Its hall samples are off, so turning wheels do not move it here: set services.serial_mcu_bridge.telemetry.publish_touch_sensors in its config.";

export function Odometry({ at, offers }) {
  const page = usePage();
  const metrics = useMetrics(at);
  const sources = Object.keys(SOURCES).filter((one) => metrics.includes(one));
  const [chosen, choose] = useState("");
  const source = sources.includes(chosen) ? chosen : (sources[0] ?? "wheel-odometry");
  const series = recorderOf(page, at).follow("poses", source, poseOf, LIMITS);
  const canvas = useRef(null);
  const view = useRef(/** @type {View | null} */ (null));
  useEffect(() => {
    if (!canvas.current) return undefined; // it was closed before it was shown
    const own = (view.current = new View(canvas.current, series));
    return () => own.close();
  }, [series]);
  useTick(WORDS_MS);
  const online = useOnline(at);
  const age = page.store.clock() - series.newestAt;
  const ended = useEnded(at, source);
  const gone = isGone({ age, period: series.gapMs / 3 }, online) || Boolean(ended && age > series.gapMs);
  if (view.current) view.current.gone = gone;
  const words = poseWords(series.newest);
  return html`<div class="map">
    ${!series.newest &&
    html`<${Nothing} icon="map" what="No trail yet">It begins with the first position that is received<//>`}
    <canvas ref=${canvas} class=${series.newest ? "map-canvas" : "map-canvas unused"} role="img" tabindex="0" data-arrows data-test="map"
      aria-label="Trail of the odometry; arrow keys move it"></canvas>
    <p class="map-words" data-test="map-pose" hidden=${!series.newest}>
      ${gone && series.newest ? html`<${Gone} age=${age}>${words}<//>` : words}
    </p>
    ${source === "wheel-odometry" &&
    offers.section("telemetry").touch_sensors === false &&
    html`<p class="map-words" data-test="map-lacks"><${Icon} name="plug" /> ${NO_SAMPLES}</p>`}
    <div class="map-tools" hidden=${!series.newest && sources.length < 2}>
      <${Button} test="map-in" label="Zoom in" onPress=${() => view.current?.zoom(1.5)}>+<//>
      <${Button} test="map-out" label="Zoom out" onPress=${() => view.current?.zoom(1 / 1.5)}>−<//>
      <${Button} test="map-centre" onPress=${() => view.current?.follow()}>Centre<//>
      <${Button} test="map-clear" onPress=${() => series.clear(page.store.clock())}>Clear trail<//>
      ${sources.length > 1 &&
      html`<${Select}
        test="map-source"
        title="Position"
        value=${source}
        choices=${sources.map((name) => [name, SOURCES[name]])}
        onChoose=${choose}
      />`}
    </div>
    ${ended && (gone || !series.newest) && html`<${Ended} at=${at} script=${ended} />`}
  </div>`;
}

/** What would find its position, and does not run. */
function Ended({ at, script: { file, label = file } }) {
  const page = useReasons(at);
  const { running, ...status } = useValue(at, "autonomy-status") ?? {};
  const why = whyNotStarted(page, at) || (running ? `One script runs at a time: stop ${scriptName(status)} first` : "");
  const words = html`<span>${plain(label)} does not run.</span>`;
  if (page.recording) return html`<p class="map-words">${words}</p>`;
  return html`<div class="map-tools" data-test="map-ended">
    ${words}
    <${Button} test="map-start" why=${why} icon="play" onPress=${() => page.commands.startScript(at, file, {})}>Start ${plain(label)}<//>
    ${why && html`<${Why} id="why-map-start">${why}<//>`}
  </div>`;
}

/** The drawing, and how it is moved: by buttons, mouse and two fingers; one finger scrolls the page. */
class View {
  /** @param {HTMLCanvasElement} canvas @param {import("../../core/series.js").Series} series */
  constructor(canvas, series) {
    this.canvas = canvas;
    this.series = series;
    this.scale = ZOOM.start;
    /** @type {{x: number, y: number} | null} what is in the middle; null: the component */
    this.middle = null;
    this.drawn = "";
    this.gone = false; // whether the newest pose is an old one
    this.seen = true;
    this.timer = setInterval(() => this.seen && !document.hidden && this.draw(), STEP_MS);
    this.sizes = browser.sizes(() => this.draw());
    this.sizes.observe(canvas);
    this.sight = more.sight((seen) => (this.seen = seen));
    this.sight.observe(canvas);
    this.listen();
  }

  close() {
    clearInterval(this.timer);
    this.sizes.disconnect();
    this.sight.disconnect();
    this.abort.abort();
  }

  /** Keep the component in the middle. */
  follow() {
    this.middle = null;
    this.draw();
  }

  /** @param {number} factor */
  zoom(factor) {
    this.scale = Math.min(ZOOM.most, Math.max(ZOOM.least, this.scale * factor));
    this.draw();
  }

  /** @param {number} dx @param {number} dy pixels */
  move(dx, dy) {
    const { x, y } = this.centre;
    this.middle = { x: x - dx / this.scale, y: y + dy / this.scale };
    this.draw();
  }

  get centre() {
    return this.middle ?? this.series.newest ?? { x: 0, y: 0 };
  }

  listen() {
    this.abort = new AbortController();
    const on = (name, fn) => this.canvas.addEventListener(name, fn, { passive: false, signal: this.abort.signal });
    on("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return; // the page scrolls; a pinch on a trackpad comes with ctrlKey
      event.preventDefault();
      this.zoom(2 ** (-event.deltaY / 200));
    });
    on("keydown", (event) => {
      const way = ARROWS[event.code];
      if (!way || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      this.move(-ARROW_PX * way[0], -ARROW_PX * way[1]);
    });
    let mouse = { x: 0, y: 0 };
    on("pointerdown", (event) => {
      mouse = { x: event.clientX, y: event.clientY };
      if (event.pointerType === "mouse") browser.capture(event);
    });
    on("pointermove", (event) => {
      if (event.pointerType !== "mouse" || !(event.buttons & 1)) return;
      this.move(event.clientX - mouse.x, event.clientY - mouse.y);
      mouse = { x: event.clientX, y: event.clientY };
    });
    /** @type {{x: number, y: number, apart: number} | null} */
    let before = null;
    const touch = (event) => {
      before = event.touches.length === 2 ? fingers(event.touches) : null;
      if (before) event.preventDefault();
    };
    for (const name of ["touchstart", "touchend", "touchcancel"]) on(name, touch);
    on("touchmove", (event) => {
      if (!before || event.touches.length !== 2) return;
      event.preventDefault();
      const now = fingers(event.touches);
      this.move(now.x - before.x, now.y - before.y);
      this.zoom(now.apart / before.apart);
      before = now;
    });
  }

  draw() {
    const { canvas, series } = this;
    const { width, height } = canvas.getBoundingClientRect();
    const pixels = devicePixelRatio || 1;
    const style = getComputedStyle(canvas);
    const colours = ["--line", "--edge", "--accent", "--dim", "--fg"].map((name) => style.getPropertyValue(name).trim());
    const { x, y } = this.centre;
    canvas.dataset.scale = String(this.scale); // for tests
    const drawn = JSON.stringify([series.version, this.gone, this.scale, x, y, width, height, pixels, colours]);
    if (drawn === this.drawn || width < 2) return;
    this.drawn = drawn;
    const [line, edge, accent, dim, ink] = colours;
    Object.assign(canvas, { width: Math.round(width * pixels), height: Math.round(height * pixels) });
    const context = canvas.getContext("2d");
    context.scale(pixels, pixels);
    /** @returns {[number, number]} */
    const place = (pose) => [width / 2 + (pose.x - x) * this.scale, height / 2 - (pose.y - y) * this.scale];
    this.drawGrid(context, { width, height, x, y, line, edge, dim });
    context.lineWidth = 2.5;
    context.lineJoin = "round";
    context.strokeStyle = accent;
    for (const piece of pieces(series.times, series.rows)) {
      context.beginPath();
      for (const pose of piece) context.lineTo(...place(pose));
      context.stroke();
    }
    const fill = this.gone ? dim : accent;
    if (series.newest) drawArrow(context, place(series.newest), series.newest.heading, ink, fill);
  }

  drawGrid(context, { width, height, x, y, line, edge, dim }) {
    const step = GRIDS.find((one) => one * this.scale >= GRID_PIXELS) ?? GRIDS[GRIDS.length - 1];
    const draw = (index, vertical) => {
      const at = index * step;
      const place = vertical ? width / 2 + (at - x) * this.scale : height / 2 - (at - y) * this.scale;
      context.strokeStyle = index === 0 ? edge : line; // the axes
      context.beginPath();
      context.moveTo(vertical ? place : 0, vertical ? 0 : place);
      context.lineTo(vertical ? place : width, vertical ? height : place);
      context.stroke();
    };
    context.lineWidth = 1;
    const half = { x: width / 2 / this.scale, y: height / 2 / this.scale };
    for (let i = Math.ceil((x - half.x) / step); i <= (x + half.x) / step; i++) draw(i, true);
    for (let i = Math.ceil((y - half.y) / step); i <= (y + half.y) / step; i++) draw(i, false);
    context.fillStyle = dim;
    context.font = "12px system-ui, sans-serif";
    context.fillText(`grid ${step} m`, 8, height - 8);
  }
}

function drawArrow(context, [x, y], heading, ink, fill) {
  context.save();
  context.translate(x, y);
  context.rotate(-heading);
  context.beginPath();
  for (const [forward, left] of [[13, 0], [-9, 8], [-5, 0], [-9, -8]]) context.lineTo(forward, -left);
  context.closePath();
  context.fillStyle = fill;
  context.strokeStyle = ink;
  context.lineWidth = 1.5;
  context.fill();
  context.stroke();
  context.restore();
}

/** Middle and distance of two fingers. @param {TouchList} touches */
function fingers([a, b]) {
  const apart = Math.max(1, Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY));
  return { x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2, apart };
}

// The last minute of one field, as a line on a canvas.

import { html, useEffect, useMedia, useRef, useTick } from "../parts/hooks.js";
import { fieldOf } from "./manifest.js";
import { plain } from "../parts/more-words.js";

const SPAN_MS = 60_000;
const APART_MS = 240; // at most so many points are kept as the span has of these
const DRAWN_MS = 250;
const CALM_MS = 2000;
const EDGE = 3; // pixels

/** @typedef {{at: number, value: unknown}} Point ``value``: the whole payload */

/** Add the newest payload, and forget what is too old. @param {Point[]} history @param {import("../../core/store.js").Value} entry */
export function remember(history, entry) {
  const last = history.at(-1);
  if (last && entry.receivedAt - last.at < APART_MS) return;
  history.push({ at: entry.receivedAt, value: entry.value });
  while (history[0].at < entry.receivedAt - SPAN_MS) history.shift();
}

/** The numbers of one field, oldest first. @param {Point[]} history @param {string} name @returns {[number, number][]} */
export function series(history, name) {
  return history
    .map(({ at, value }) => ({ at, value: fieldOf(value, name) }))
    .filter(({ value }) => typeof value === "boolean" || Number.isFinite(value))
    .map(({ at, value }) => /** @type {[number, number]} */ ([at, Number(value)]));
}

/**
 * The points of the last minute, and the newest one: unless it is ``gone``, it still holds.
 * @template {{at: number}} T @param {T[]} points @param {number} now @param {boolean} gone @returns {T[]}
 */
export const lastMinute = (points, now, gone) =>
  points.filter(({ at }, index) => at >= now - SPAN_MS || (!gone && index === points.length - 1));

/** @param {{field: import("./manifest.js").Field, history: {current: Point[]}, gone: boolean}} props */
export function Spark({ field, history, gone }) {
  const calm = useMedia("(prefers-reduced-motion: reduce)");
  useTick(calm ? CALM_MS : DRAWN_MS);
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const points = series(lastMinute(history.current, performance.now(), gone), field.name);
  useEffect(() => {
    if (canvas.current) draw(canvas.current, points, gone);
  });
  const numbers = points.map(([, number]) => number);
  const unit = field.unit && ` ${field.unit}`;
  const words = numbers.length ? `${plain(Math.min(...numbers))} to ${plain(Math.max(...numbers))}${unit}` : "no values";
  return html`<div class="spark">
    <canvas ref=${canvas} role="img" aria-label=${`${field.name}, last minute: ${words}`} data-test="spark"></canvas>
    <small>last minute: ${words}</small>
  </div>`;
}

/** @param {HTMLCanvasElement} canvas @param {[number, number][]} points @param {boolean} gone */
function draw(canvas, points, gone) {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  if (!context || !points.length) return;
  const now = performance.now();
  const numbers = points.map(([, number]) => number);
  const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  const x = (at) => EDGE + (width - 2 * EDGE) * (1 - (now - at) / SPAN_MS);
  const y = (number) => (high > low ? height - EDGE - ((number - low) / (high - low)) * (height - 2 * EDGE) : height / 2);
  context.scale(ratio, ratio);
  context.strokeStyle = getComputedStyle(canvas).color;
  context.lineWidth = 2;
  context.lineJoin = "round";
  context.beginPath();
  for (const [at, number] of points) context.lineTo(x(at), y(number));
  if (!gone) context.lineTo(x(now), y(numbers[numbers.length - 1])); // it holds until the next one
  context.stroke();
}

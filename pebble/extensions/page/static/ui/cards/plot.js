// Draws the lines of one plot with uPlot, a few times a second and only while they are seen.

import * as browser from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import made from "../../vendor/uPlot.mjs";
import { spread } from "../../core/plot-choices.js";
import { html, useEffect, usePage, useRef } from "../parts/hooks.js";
import { clockTime } from "../parts/words.js";

/** @type {any} it has no types here */
const uPlot = made;

const STEP_MS = 100; // at most ten times a second
const CALM_MS = 1000; // where people ask for less motion, and where a pixel is longer than that
const HEIGHT = 132;
const LEAST_MS = 20_000; // so much time is shown at least
/** Colour alone does not tell lines apart; plots.css has the same dashes. */
const DASHES = [[], [7, 4], [2, 3], [10, 3, 2, 3], [12, 6], [1, 5]];

/** @param {{series: import("../../core/series.js").Series, fields: string[], shownMs: number, least?: number, paused: boolean}} props */
export function Lines({ series, fields, shownMs, least, paused }) {
  const { store } = usePage();
  const place = useRef(null);
  const stopped = useRef(paused);
  stopped.current = paused;
  useEffect(() => {
    const element = /** @type {HTMLElement | null} */ (place.current);
    if (!element) return undefined; // it was closed before it was shown
    const view = new View(element, fields, least);
    const calm = browser.media("(prefers-reduced-motion: reduce)");
    let seen = true;
    let drawnAt = -Infinity;
    const draw = () => {
      const now = store.clock();
      const pixelMs = shownMs / Math.max(1, view.width);
      const step = calm.matches ? CALM_MS : Math.min(CALM_MS, pixelMs);
      if (!seen || view.recoloured() || stopped.current || Math.abs(now - drawnAt) < step) return;
      drawnAt = now;
      view.draw(series.columns(fields, now - shownMs, now), now - shownMs, now, store.offset);
    };
    const sizes = browser.sizes(() => view.resize(element.clientWidth));
    const sight = more.sight((is) => (seen = is));
    sizes.observe(element);
    sight.observe(element);
    draw();
    drawnAt = -Infinity; // what comes with the page's other messages is drawn with the next step
    const timer = setInterval(() => document.hidden || draw(), STEP_MS);
    return () => {
      clearInterval(timer);
      sizes.disconnect();
      sight.disconnect();
      view.close();
    };
  }, []);
  return html`<div class="plot-lines" ref=${place} aria-hidden="true"></div>`;
}

/** One plot on the page. */
class View {
  /** @param {HTMLElement} element @param {string[]} fields @param {number | undefined} least */
  constructor(element, fields, least) {
    const style = getComputedStyle(element);
    const colour = (name) => () => style.getPropertyValue(name).trim(); // live: it follows the theme
    const lines = fields.map((label, index) => ({
      label,
      stroke: colour(`--line-${index}`),
      dash: DASHES[index],
      width: 1.5,
      points: { show: (_plot, _series, first, last) => last - first < 3, size: 4 },
    }));
    const axis = {
      stroke: colour("--dim"),
      font: "12px system-ui, sans-serif",
      grid: { stroke: colour("--line"), width: 1 },
      ticks: { stroke: colour("--line"), width: 1, size: 4 },
    };
    this.style = style;
    this.theme = "";
    this.range = [0, 1];
    this.width = Math.max(80, element.clientWidth);
    this.plot = new uPlot(
      {
        width: this.width,
        height: HEIGHT,
        legend: { show: false },
        cursor: { show: false },
        padding: [6, 28, 0, 0], // half of a time
        scales: {
          x: { time: false, range: () => this.range },
          y: { range: (_plot, low, high) => spread(low, high, least) },
        },
        axes: [
          { ...axis, size: 28, space: 90, incrs: [5, 10, 30, 60, 120, 300], values: (_plot, at) => at.map((s) => clockTime(1000 * s)) },
          { ...axis, size: 52, space: 28 },
        ],
        series: [{}, ...lines],
      },
      [[], ...fields.map(() => [])],
      element,
    );
  }

  /** @param {any} columns times in ms of the page's clock @param {number} from @param {number} to @param {number} offset to epoch */
  draw([times, ...values], from, to, offset) {
    const first = Math.max(from, Math.min(times[0] ?? from, to - LEAST_MS)); // the axis begins with the data
    this.range = [(first + offset) / 1000, (to + offset) / 1000];
    this.plot.setData([times.map((at) => (at + offset) / 1000), ...values]);
  }

  /** Draw again, if the theme is another one. */
  recoloured() {
    const theme = this.style.getPropertyValue("--fg");
    if (theme === this.theme) return false;
    if (this.theme) this.plot.redraw(false);
    this.theme = theme;
    return true;
  }

  resize(width) {
    if (width < 80 || width === this.width) return;
    this.width = width;
    this.plot.setSize({ width, height: HEIGHT });
  }

  close() {
    this.plot.destroy();
  }
}

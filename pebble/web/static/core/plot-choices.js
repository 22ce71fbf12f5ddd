/** Which plots there are: the usual ones, and those that a person adds. Pure. */

import { numbers } from "./series.js";

export const MOST_ADDED = 6;
export const MOST_LINES = 6;
const MOST_CHOICES = 200;
const MINUTES = 60_000;

/**
 * ``fields``: names within the metric's numbers; null: all of them, up to six. ``least``: the smallest range of values
 * that is shown. ``first``: it is shown before all of them are asked for.
 * @typedef {{id: string, title: string, metric: string, fields: string[] | null, digits?: number, unit?: string,
 *   least?: number, first?: boolean}} Plot
 */

/** @type {Plot[]} */
export const USUAL = [
  { id: "battery", title: "Battery", metric: "charging-level", fields: ["value"], digits: 2, least: 0.2, first: true },
  { id: "touch", title: "Touch", metric: "touch-sensors", fields: null, digits: 0, least: 20 },
  {
    id: "attitude",
    title: "Roll, pitch",
    metric: "sensors/imu",
    fields: ["orientation_deg.roll", "orientation_deg.pitch"],
    digits: 1,
    unit: "°",
    least: 2,
  },
  {
    id: "rates",
    title: "Turn rates",
    metric: "sensors/imu",
    fields: ["gyro_dps.x", "gyro_dps.y", "gyro_dps.z"],
    digits: 1,
    unit: "°/s",
    least: 2,
    first: true,
  },
  {
    id: "acceleration",
    title: "Acceleration",
    metric: "sensors/imu",
    fields: ["accel_norm_g"],
    digits: 2,
    unit: "g",
    least: 0.1,
  },
];

/** How much of a metric is shown, and remembered. @param {string} metric */
export function limitsOf(metric) {
  const spanMs = metric === "charging-level" ? 10 * MINUTES : 2 * MINUTES;
  return { spanMs: spanMs + 5000, most: 2600, shownMs: spanMs };
}

/** @param {Plot} plot @param {Record<string, number> | null} row the newest numbers @returns {string[]} the lines of a plot */
export function fieldsOf(plot, row) {
  return (plot.fields ?? Object.keys(row ?? {})).slice(0, MOST_LINES);
}

/** What a line is called: the last part of its name. @param {string} field @param {Plot} plot */
export const nameOfLine = (field, plot) => (field === "value" ? plot.title.toLowerCase() : field.slice(field.lastIndexOf(".") + 1));

/**
 * What may be added of one metric: every number, and every group of two to six.
 * @param {string} metric @param {unknown} payload @returns {Plot[]}
 */
export function choices(metric, payload) {
  const names = Object.keys(numbers(payload) ?? {});
  /** @type {Map<string, string[]>} */
  const groups = new Map();
  for (const name of names) {
    const group = name.includes(".") ? name.slice(0, name.lastIndexOf(".")) : "";
    groups.set(group, [...(groups.get(group) ?? []), name]);
  }
  const together = [...groups].filter(([group, fields]) => group && fields.length > 1 && fields.length <= MOST_LINES);
  /** @type {[string, string[]][]} */
  const alone = names.map((name) => [name, [name]]);
  return [...together, ...alone].slice(0, MOST_CHOICES).map(([name, fields]) => ({
    id: `${metric} ${name}`,
    title: name === "value" ? metric : `${metric} ${name}`,
    metric,
    fields,
  }));
}

/** What was remembered, if it is a list of plots. @param {unknown} stored @returns {Plot[]} */
export function restored(stored) {
  const plots = (Array.isArray(stored) ? stored : []).filter(isPlot).slice(0, MOST_ADDED);
  return plots.map(({ id, title, metric, fields }) => ({ id, title, metric, fields: fields.slice(0, MOST_LINES) }));
}

const isText = (value) => typeof value === "string" && value.length > 0 && value.length < 300;

/** @param {any} one */
const isPlot = (one) =>
  isText(one?.id) && isText(one.title) && isText(one.metric) && Array.isArray(one.fields) && one.fields.every(isText);

/** A range of values with some room around, and not less than ``least``. @returns {[number, number]} */
export function spread(low, high, least = 0) {
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [0, 1];
  const smallest = Math.max(least, 1e-6 * Math.max(Math.abs(low), Math.abs(high)), 1e-9);
  const room = Math.max(0.08 * (high - low), (smallest - (high - low)) / 2);
  return [low - room, high + room];
}

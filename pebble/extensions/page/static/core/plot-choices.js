/** Which plots there are: the usual ones, and those of all numbers of a metric. Pure. */

import { numbers } from "./series.js";

const MOST_LINES = 6;
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
 * All numbers of one metric: those that stand together in it in one plot, every other one in its own.
 * @param {string} metric @param {unknown} payload @returns {Plot[]}
 */
export function plotsOf(metric, payload) {
  /** @type {Map<string, string[]>} */
  const groups = new Map();
  for (const field of Object.keys(numbers(payload) ?? {})) {
    const group = field.includes(".") ? field.slice(0, field.lastIndexOf(".")) : field;
    groups.set(group, [...(groups.get(group) ?? []), field]);
  }
  return [...groups].map(([group, fields]) => ({
    id: `${metric} ${group}`,
    title: group === "value" ? metric : `${metric} ${group}`,
    metric,
    fields,
  }));
}

/** A range of values with some room around, and not less than ``least``. @returns {[number, number]} */
export function spread(low, high, least = 0) {
  if (!Number.isFinite(low) || !Number.isFinite(high)) return [0, 1];
  const smallest = Math.max(least, 1e-6 * Math.max(Math.abs(low), Math.abs(high)), 1e-9);
  const room = Math.max(0.08 * (high - low), (smallest - (high - low)) / 2);
  return [low - room, high + room];
}

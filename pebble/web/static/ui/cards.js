// Which cards there are, in their fixed order. A new one is a line here, and a module that is fetched when it is shown.

import { fetchStyle } from "./hooks.js";
import { Telemetry } from "./telemetry.js";

/**
 * ``tab``: where it is on a phone. ``wants``: whether this component has it. ``part``: fetches what draws it; a
 * component with ``at`` and ``offers``.
 * @typedef {{id: string, title: string, icon: string, tab: string, wants: (offers: any) => boolean,
 *   part: () => Promise<any>}} CardKind
 */

/** @template T @param {Promise<T>} part one of those that share a style sheet */
const withStyle = async (part) => (await Promise.all([part, fetchStyle("devices.css")]))[0];

/** @type {CardKind[]} */
export const CARDS = [
  { id: "telemetry", title: "Telemetry", icon: "gauge", tab: "sensors", wants: () => true, part: async () => Telemetry },
  {
    id: "lights",
    title: "Lights",
    icon: "light",
    tab: "more",
    wants: (offers) => offers.hasLights,
    part: async () => (await import("./lights.js")).Lights,
  },
  {
    id: "sounds",
    title: "Sounds",
    icon: "sound",
    tab: "sound",
    wants: (offers) => offers.has("soundboard"),
    part: async () => (await import("./sounds.js")).Sounds,
  },
  {
    id: "autonomy",
    title: "Autonomy",
    icon: "script",
    tab: "more",
    wants: (offers) => offers.has("autonomy"),
    part: async () => (await import("./autonomy.js")).Autonomy,
  },
  {
    id: "outlets",
    title: "Outlets",
    icon: "plug",
    tab: "more",
    wants: (offers) => offers.section("outlets").available === true || offers.received("outlets/"),
    part: async () => (await withStyle(import("./outlets.js"))).Outlets,
  },
  {
    id: "map",
    title: "Map",
    icon: "map",
    tab: "sensors",
    wants: (offers) => offers.section("telemetry").wheel_odometry === true,
    part: async () => (await import("./map.js")).Odometry,
  },
  {
    id: "plots",
    title: "Plots",
    icon: "plot",
    tab: "sensors",
    wants: () => true,
    part: async () => (await import("./plots.js")).Plots,
  },
  {
    id: "mcus",
    title: "Microcontrollers",
    icon: "chip",
    tab: "more",
    wants: (offers) => offers.metrics.some((metric) => metric.endsWith("/describe")),
    part: async () => (await withStyle(import("./mcus.js"))).Mcus,
  },
  {
    id: "logs",
    title: "Logs",
    icon: "list",
    tab: "more",
    wants: (offers) => offers.isRobot,
    part: async () => (await import("./logs.js")).Logs,
  },
  {
    id: "system",
    title: "System",
    icon: "power",
    tab: "more",
    wants: (offers) => offers.has("system"),
    part: async () => (await import("./system.js")).System,
  },
  {
    id: "values",
    title: "All values",
    icon: "list",
    tab: "more",
    wants: () => true,
    part: async () => (await withStyle(import("./values.js"))).Values,
  },
];

/** Tabs of a phone, in order; those without any card are left out. */
export const TABS = [
  { id: "drive", title: "Drive", icon: "wheel" },
  { id: "sensors", title: "Sensors", icon: "gauge" },
  { id: "sound", title: "Sound", icon: "sound" },
  { id: "more", title: "More", icon: "list" },
];

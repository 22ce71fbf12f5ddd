// Which cards there are, in their fixed order. A new one is a line here.

import { Telemetry } from "./telemetry.js";
import { Values } from "./values.js";

/**
 * ``tab``: where it is on a phone. ``wants``: whether this component has it; ``lacks``: what is said if it has not.
 * @type {{id: string, title: string, icon: string, tab: string, wants: (offers: any) => boolean, body: any}[]}
 */
export const CARDS = [
  { id: "telemetry", title: "Telemetry", icon: "gauge", tab: "sensors", wants: () => true, body: Telemetry },
  { id: "values", title: "All values", icon: "list", tab: "more", wants: () => true, body: Values },
];

/** Tabs of a phone, in order; those without any card are left out. */
export const TABS = [
  { id: "drive", title: "Drive", icon: "wheel" },
  { id: "sensors", title: "Sensors", icon: "gauge" },
  { id: "sound", title: "Sound", icon: "sound" },
  { id: "more", title: "More", icon: "list" },
];

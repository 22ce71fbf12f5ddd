// How a robot looks to people: as its capabilities say, and where they say nothing, by its id and by what it offers.

import { battery, inner, nameOf, typeOf, visible } from "./words.js";

const FACES = new URL("../../faces.svg", import.meta.url).href;

/** The order decides which colour an id has. */
export const TINTS = ["blue", "amber", "violet", "green", "coral", "rose", "teal", "slate"];

/** The drawings in faces.svg, as pebble/config/types.py allows them. */
export const PICTURES = {
  goob: "Rover with a camera mast",
  fred: "Toy's body with new electronics",
  minilamp: "Rover with a lamp arm",
  benjr: "Walker on a Strandbeest's legs",
  pitcam: "Camera on a charging mast",
  outlets: "Outlets",
  wheeled: "Robot on wheels",
  walker: "Walker",
  arm: "Robot arm",
  drone: "Drone",
  boat: "Boat",
  unknown: "",
};

/** Ids of the original's robots that are not the name of their drawing, and the colours of those that are. */
const BODIES = { bumperbot: "benjr" };
const COLOURS = { goob: "blue", fred: "amber", minilamp: "violet", benjr: "green", pitcam: "teal" };

/**
 * @param {string} ref @param {any} capabilities payload
 * @returns {{name: string, description: string, colour: string, picture: string, cells: number}} ``cells`` 0: unknown
 */
export function looksOf(ref, capabilities) {
  const value = capabilities?.value ?? {};
  /** @type {Partial<import("../../messages.js").RobotIdentity>} */
  const identity = value.identity ?? {};
  const id = nameOf(ref);
  const body = Object.hasOwn(BODIES, id) ? BODIES[id] : id;
  const picture = Object.hasOwn(PICTURES, identity.picture) ? identity.picture : assumed(body, value);
  return {
    name: called(text(identity.name, 32), visible(id)),
    description: text(identity.description, 60) || PICTURES[picture],
    colour: TINTS.includes(identity.colour) ? identity.colour : Object.hasOwn(COLOURS, body) ? COLOURS[body] : TINTS[hash(id) % TINTS.length],
    picture,
    cells: Math.max(0, identity.battery_cells ?? 0),
  };
}

/** @param {any} store @param {string} ref @returns {string} what people call it */
export const nameIn = (store, ref) => looksOf(ref, store.get(ref, "capabilities")?.value).name;

/** @param {string} picture @returns {string} the address of its drawing */
export const drawing = (picture) => `${FACES}#face-${picture}`;

/** @param {string} ref @returns {boolean} whether it has a face: towers and others have the icon of their type */
export const hasFace = (ref) => typeOf(ref) === "robots";

/** A name is what the robot's account says, and another robot may say the same: only the id is one robot's. */
function called(name, id) {
  const [one, other] = [name, id].map((each) => each.toLowerCase().replace(/[ _-]/g, ""));
  return !name ? id : one === other ? name : `${name} (${id})`;
}

function assumed(body, value) {
  if (Object.hasOwn(PICTURES, body)) return body;
  if (value.drive?.available) return "wheeled";
  return value.outlets?.available ? "outlets" : "unknown";
}

const text = (value = "", most) => visible(value.trim().slice(0, most));

function hash(id) {
  let sum = 0;
  for (const letter of id) sum = (31 * sum + letter.charCodeAt(0)) % 65_521;
  return sum;
}

export const LOW_PERCENT = 20;

/** Percent by volts of one lithium cell at rest; between two rows in proportion. */
const CHARGE = [[3, 0], [3.45, 5], [3.68, 10], [3.74, 20], [3.77, 30], [3.79, 40], [3.82, 50], [3.87, 60], [3.92, 70],
  [3.98, 80], [4.06, 90], [4.2, 100]];

/** @param {any} level payload of charging-level @param {number} cells @returns {number | null} percent; null: unknown */
export function charge(level, cells) {
  const value = inner(level);
  const unit = typeof level?.unit === "string" ? level.unit.toLowerCase() : "";
  if (!Number.isFinite(value)) return null;
  if (unit === "%") return value;
  if (unit !== "v" || !cells) return null;
  const volts = value / cells;
  const above = CHARGE.findIndex(([one]) => one >= volts);
  if (above === 0) return 0;
  if (above < 0) return 100;
  const [[low, from], [high, to]] = [CHARGE[above - 1], CHARGE[above]];
  return Math.round(from + ((to - from) * (volts - low)) / (high - low));
}

/**
 * @param {any} level payload of charging-level @param {number} cells @param {number} [digits] of volts
 * @returns {string} 81 %, or 7.92 V
 */
export function chargeWords(level, cells, digits = 2) {
  const percent = charge(level, cells);
  return percent === null ? battery(level, digits) : `${percent} %`;
}

// The clips of each robot, and which one was played from here last.

import { Model } from "../parts/models.js";
import { whyNot } from "../parts/why-not.js";

const LONGEST_NAME = 1000; // characters, of the server

/** What was chosen here for one robot, since the page was loaded. */
export class Sounds extends Model {
  constructor() {
    super();
    this.filter = "";
    this.repeat = false; // until stopped
    /** @type {{file: string, repeat: boolean} | null} */
    this.last = null;
  }

  /** @param {Partial<Pick<Sounds, "filter" | "repeat" | "last">>} change */
  set(change) {
    Object.assign(this, change);
    this.changed();
  }
}

const all = new Map();

/** @param {string} ref @returns {Sounds} */
export function soundsOf(ref) {
  if (!all.has(ref)) all.set(ref, new Sounds());
  return all.get(ref);
}

/**
 * @param {any} page its services @param {string} ref @param {string} file @param {boolean} repeat
 * @returns {string} why not; "" it was asked
 */
export function play(page, ref, file, repeat) {
  const why = whyNot(page, ref, "soundboard") || (file.length > LONGEST_NAME ? "Its name is too long" : "");
  if (!why) {
    page.commands.playSound(ref, file, repeat);
    soundsOf(ref).set({ last: { file, repeat } });
  }
  return why;
}

/**
 * Play the last clip once more, as it was played then. For the key P.
 * @param {any} page its services @param {string} ref @returns {string} why not; "" it was asked
 */
export function repeatLast(page, ref) {
  const { last } = soundsOf(ref);
  return last ? play(page, ref, last.file, last.repeat) : whyNot(page, ref, "soundboard") || "Play one sound first";
}

/**
 * The clips whose names contain every word of ``filter``: the first ``most`` of them by folder, and how many more.
 * @param {string[]} files @param {string} filter @param {number} most
 * @returns {{folders: [string, string[]][], more: number}}
 */
export function grouped(files, filter, most) {
  const words = filter.toLowerCase().split(/\s+/);
  const found = files.filter((file) => words.every((word) => file.toLowerCase().includes(word)));
  /** @type {Map<string, string[]>} */
  const folders = new Map();
  for (const file of found.slice(0, most)) {
    const folder = file.slice(0, file.lastIndexOf("/") + 1);
    folders.set(folder, [...(folders.get(folder) ?? []), file]);
  }
  return { folders: [...folders], more: Math.max(0, found.length - most) };
}

// The log lines of the component that is open, and how they are filtered; it stays while other cards are shown.

import { LogBook } from "../../core/logs.js";
import { Model } from "./models.js";

export class LogView extends Model {
  /** @param {string} ref */
  constructor(ref) {
    super();
    this.ref = ref;
    this.book = new LogBook();
    this.filter = { rank: 0, service: "", search: "" };
    this.follows = true;
    this.cleared = false;
  }

  /** @param {{ref: string, origin: string, first: number, lines: unknown[]}} message */
  take(message) {
    if (message.ref !== this.ref) return;
    this.book.take(message);
    this.changed();
  }

  /** @param {Partial<import("../../core/logs.js").Filter>} filter */
  choose(filter) {
    this.filter = { ...this.filter, ...filter };
    this.changed();
  }

  /** @param {boolean} follows */
  follow(follows) {
    if (follows === this.follows) return;
    this.follows = follows;
    this.changed();
  }

  clear() {
    this.book.clear();
    this.cleared = true;
    this.changed();
  }
}

/** @type {WeakMap<object, LogView>} */
const views = new WeakMap();

/** @param {object} store of the page, or of a replay @param {string} ref @returns {LogView} the one of this component */
export function logViewOf(store, ref) {
  let view = views.get(store);
  if (view?.ref !== ref) views.set(store, (view = new LogView(ref)));
  return view;
}

// Remembers metrics of the component that is open, from the first widget that wants them until another one is opened.

import { Series } from "../../core/series.js";

const recorders = new WeakMap(); // by store

/** @param {any} page the services @param {string} ref @returns {Recorder} the one of this component */
export function recorderOf(page, ref) {
  let recorder = recorders.get(page.store);
  if (recorder?.ref !== ref) {
    recorder?.close();
    recorders.set(page.store, (recorder = new Recorder(page, ref)));
  }
  return recorder;
}

class Recorder {
  constructor({ store }, ref) {
    this.store = store;
    this.ref = ref;
    /** @type {Map<string, Series>} */
    this.all = new Map();
    /** @type {(() => void)[]} */
    this.ends = [];
  }

  /**
   * @param {string} name of what is remembered of it @param {string} metric @param {(payload: unknown) => any} pick
   * @param {{spanMs: number, most: number, differs?: (row: any, last: any, ms: number) => boolean}} limits
   * @returns {Series} the same one each time
   */
  follow(name, metric, pick, limits) {
    const key = `${name} ${metric}`;
    let series = this.all.get(key);
    if (!series) {
      this.all.set(key, (series = new Series(pick, limits)));
      this.record(series, metric);
    }
    return series;
  }

  /** Time has jumped: what is remembered does not go on. */
  restart() {
    for (const series of this.all.values()) series.restart();
  }

  /** @param {Series} series @param {string} metric */
  record(series, metric) {
    const { store, ref } = this;
    const live = () => {
      const entry = store.get(ref, metric);
      if (entry) series.push(entry.receivedAt, entry.value);
    };
    live();
    this.ends.push(store.subscribe(ref, metric, live));
  }

  close() {
    for (const end of this.ends) end();
  }
}

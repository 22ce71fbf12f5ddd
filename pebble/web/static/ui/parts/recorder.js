// Remembers metrics of the component that is open, from the first widget that wants them until another one is opened.

import { Series } from "../../core/series.js";

const ASKS_MS = 2000; // between two requests for the past: several widgets open at once
const PAST = "web/series/"; // where main.js puts what the server has, by metric

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
  constructor({ store, connection, commands, driver }, ref) {
    this.store = store;
    this.commands = commands;
    this.driver = driver;
    this.ref = ref;
    /** @type {Map<string, Series>} */
    this.all = new Map();
    this.askedAt = -Infinity;
    let open = connection.isOpen;
    const unsubscribe = connection.onChange(() => {
      if (connection.isOpen && !open) this.ask(); // what was sent meanwhile
      open = connection.isOpen;
    });
    /** @type {(() => void)[]} */
    this.ends = [unsubscribe];
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
      if (this.store.clock() - this.askedAt > ASKS_MS) this.ask();
    }
    return series;
  }

  /** Time has jumped: what is remembered does not go on. */
  restart() {
    for (const series of this.all.values()) series.restart();
  }

  ask() {
    if (this.driver.ref !== this.ref) return; // another one is open meanwhile
    if (this.commands.askSeries(this.ref)) this.askedAt = this.store.clock();
  }

  /** @param {Series} series @param {string} metric */
  record(series, metric) {
    const { store, ref } = this;
    let known = null; // the store makes another one for each connection
    const newest = () => {
      const entry = store.get(ref, metric) ?? null;
      if (known && entry !== known) series.begin();
      known = entry;
      return entry;
    };
    const live = () => {
      const entry = newest();
      if (entry) series.push(entry.receivedAt, entry.value);
    };
    const past = () => {
      const message = store.get(ref, PAST + metric)?.value;
      if (!message) return;
      newest();
      const now = message.now - store.offset; // the server's time, on the page's clock
      series.past(message.points.map(([age, payload]) => [now - age, payload]));
    };
    live();
    past();
    this.ends.push(store.subscribe(ref, metric, live), store.subscribe(ref, PAST + metric, past));
  }

  close() {
    for (const end of this.ends) end();
    const { store, ref } = this;
    for (const metric of store.metrics(ref)) if (metric.startsWith(PAST)) store.drop(ref, metric);
  }
}

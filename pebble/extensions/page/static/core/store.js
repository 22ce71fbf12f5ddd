// The newest value of every component and metric, and who wants to know when it changes. No framework, no DOM.

const STEP_MS = 50; // subscribers are called at most this often, and at most once per animation frame
const SYNCS = 60; // half a minute of pings
const INTERVALS = 5; // between updates, from which the period of a value is estimated

/** @typedef {import("../messages.js").Metrics} Metrics */

/** One value. Ages are measured by a clock that nothing sets. @template [V=any] */
export class Value {
  /** @param {Store} store @param {V} value @param {number} receivedAt of performance.now() */
  constructor(store, value, receivedAt) {
    this.store = store;
    this.value = value;
    this.receivedAt = receivedAt;
    /** Usual time between updates in ms; 0 while it is not known. */
    this.period = 0;
    /** @type {number[]} */
    this.intervals = [];
  }

  /** Its age in ms. */
  get age() {
    return Math.max(0, this.store.clock() - this.receivedAt);
  }

  /** @param {V} value @param {number} receivedAt */
  replace(value, receivedAt) {
    const interval = receivedAt - this.receivedAt;
    if (interval > 5) {
      this.intervals.push(interval);
      if (this.intervals.length > INTERVALS) this.intervals.shift();
    }
    if (this.intervals.length >= 3) {
      this.period = [...this.intervals].sort((a, b) => a - b)[this.intervals.length >> 1];
    }
    this.value = value;
    this.receivedAt = receivedAt;
  }
}

/** All values by component and metric. ``ref`` "" is the server. */
export class Store {
  /** @param {() => number} [clock] ms, monotonic @param {(fn: () => void) => void} [soon] calls fn a little later */
  constructor(clock = () => performance.now(), soon = nextFrame) {
    this.clock = clock;
    this.soon = soon;
    this.offset = Date.now() - clock();
    /** @type {number[]} */
    this.offsets = [];
    /** @type {number[]} */
    this.roundTrips = [];
    /** @type {Map<string, Map<string, Value>>} */
    this.components = new Map();
    /** @type {Map<string, Set<() => void>>} */
    this.subscribers = new Map();
    /** @type {Set<string>} */
    this.changed = new Set();
    this.pending = false;
  }

  /**
   * @template {string} M @param {string} ref @param {M} metric
   * @returns {Value<M extends keyof Metrics ? Metrics[M] : any> | undefined}
   */
  get(ref, metric) {
    return this.components.get(ref)?.get(metric);
  }

  /** @param {string} ref @returns {string[]} the metrics of which there is a value */
  metrics(ref) {
    return [...(this.components.get(ref)?.keys() ?? [])];
  }

  /** @returns {string[]} all components, without the server itself */
  refs() {
    return [...this.components.keys()].filter((ref) => ref !== "");
  }

  /** @param {string} ref @param {string} metric @param {unknown} value @param {number} [ageMs] */
  set(ref, metric, value, ageMs = 0) {
    let metrics = this.components.get(ref);
    if (!metrics) {
      this.components.set(ref, (metrics = new Map()));
      this.mark("\n");
    }
    const receivedAt = this.clock() - ageMs;
    const old = metrics.get(metric);
    if (old) {
      old.replace(value, receivedAt);
    } else {
      metrics.set(metric, new Value(this, value, receivedAt));
      this.mark("\n" + ref);
    }
    this.markMetric(ref, metric);
  }

  markMetric(ref, metric) {
    this.mark(metric + "\n" + ref);
    this.mark(metric + "\n");
  }

  /** @param {string} ref */
  remove(ref) {
    for (const metric of this.metrics(ref)) this.markMetric(ref, metric);
    if (this.components.delete(ref)) {
      this.mark("\n");
      this.mark("\n" + ref);
    }
  }

  /** @param {string} ref @param {string} metric */
  drop(ref, metric) {
    if (!this.components.get(ref)?.delete(metric)) return;
    this.mark("\n" + ref);
    this.markMetric(ref, metric);
  }

  /** Remove everything: after a new connection the server sends all that there is. */
  clear() {
    for (const ref of [...this.components.keys()]) this.remove(ref);
  }

  /**
   * Call ``fn`` after changes: of one metric, with ``ref`` null of any component; with ``metric`` null when a component receives a metric it had not, or
   * loses one; with both null when a component appears or disappears.
   * @param {string | null} ref @param {string | null} metric @param {() => void} fn @returns {() => void} unsubscribe
   */
  subscribe(ref, metric, fn) {
    const key = `${metric ?? ""}\n${ref ?? ""}`;
    let group = this.subscribers.get(key);
    if (!group) this.subscribers.set(key, (group = new Set()));
    group.add(fn);
    return () => {
      group.delete(fn);
      if (!group.size && this.subscribers.get(key) === group) this.subscribers.delete(key);
    };
  }

  /** @returns {number} epoch ms of the server, as far as it is known */
  now() {
    return this.clock() + this.offset;
  }

  /**
   * Take the server's clock from a message. One that is late makes the server's clock look slow, never fast: of the
   * newest messages the one that looks fastest counts.
   * @param {number} serverNow epoch ms @param {number} [roundTripMs] of the connection; negative: unknown
   */
  sync(serverNow, roundTripMs = -1) {
    this.offsets.push(serverNow - this.clock());
    if (roundTripMs >= 0) this.roundTrips.push(roundTripMs);
    if (this.offsets.length > SYNCS) this.offsets.shift();
    if (this.roundTrips.length > SYNCS) this.roundTrips.shift();
    this.offset = Math.max(...this.offsets) + (this.roundTrips.length ? Math.min(...this.roundTrips) / 2 : 0);
  }

  /** @param {string} key */
  mark(key) {
    this.changed.add(key);
    if (this.pending) return;
    this.pending = true;
    this.soon(() => this.flush());
  }

  flush() {
    this.pending = false;
    const changed = this.changed;
    this.changed = new Set();
    const due = new Set();
    for (const key of changed) for (const fn of this.subscribers.get(key) ?? []) due.add(fn);
    callAll(due);
  }
}

/** What fails is reported, and keeps none of the others from being called. @param {Iterable<() => void>} fns */
export function callAll(fns) {
  for (const fn of [...fns]) {
    try {
      fn();
    } catch (error) {
      queueMicrotask(() => { throw error; });
    }
  }
}

let flushedAt = -Infinity;

/** @param {() => void} fn */
function nextFrame(fn) {
  const run = () => {
    flushedAt = performance.now();
    fn();
  };
  // a hidden page has no animation frames
  const frame = () => (document.hidden ? setTimeout(run, 200) : requestAnimationFrame(run));
  const wait = flushedAt + STEP_MS - performance.now();
  if (wait > 0) setTimeout(frame, wait);
  else frame();
}

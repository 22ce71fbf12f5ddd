/** Who has control of the robot that is open, as this page sees it. */

export class Lease {
  /** @param {any} store @param {any} socket */
  constructor(store, socket) {
    this.store = store;
    this.socket = socket;
    this.ref = "";
    this.mine = false;
    this.passedOver = ""; // who was not let drive
    this.idleFrom = Infinity; // since when it is not used
    /** @type {(by: string, idleMs: number) => void} called when this page loses it: to ``by``, or "" */
    this.onLost = () => {};
  }

  get view() {
    return this.store.get(this.ref, "web/driver")?.value;
  }

  /** @param {string} ref */
  select(ref) {
    this.ref = ref;
    this.mine = false;
  }

  take(over) {
    this.socket.send({ op: "lease", ref: this.ref, take: true, over });
  }

  release() {
    this.mine = false;
    this.socket.send({ op: "lease", ref: this.ref, take: false });
  }

  /** Who asks this page for control, and was not refused; "" nobody. */
  get asks() {
    const { view } = this;
    return view?.you && view.asks !== this.passedOver ? view.asks : "";
  }

  /** Do not let drive who asks now. */
  keep() {
    this.passedOver = this.asks;
  }

  /** How long its holder has not driven; -1: not known. */
  idleMs() {
    const entry = this.store.get(this.ref, "web/driver");
    const idle = entry?.value.idle_s;
    return typeof idle === "number" ? 1000 * idle + entry.age : -1;
  }

  watch() {
    const { view } = this;
    if (this.socket.state !== "open" || !view) return;
    const now = performance.now();
    if (this.mine && !view.you) this.onLost(view.by, Math.max(0, now - this.idleFrom));
    this.mine = view.you;
    if (!view.asks) this.passedOver = "";
    const idle = this.idleMs();
    if (this.mine) this.idleFrom = idle < 0 ? Infinity : now - idle;
  }
}

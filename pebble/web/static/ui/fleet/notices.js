// What an operator of many robots should learn without looking at each: a bell in the header, and its list.

import { Notices, Watcher, aloud } from "../../core/notices.js";
import { DoubtMark } from "./doubt.js";
import { html, useEffect, useModel, usePage, useRef, useRefs, useState, useValue } from "../parts/hooks.js";
import { Model, read, write } from "../parts/models.js";
import { Panel } from "../panels/panel.js";
import { nameIn } from "../parts/looks.js";
import { Icon, RouteLink, useName } from "../parts/parts.js";
import { RecordingsLink } from "./recordings-link.js";
import { shortTime } from "../parts/more-words.js";
import { Typed } from "../parts/typed.js";
import { battery, inner, isObject, nameOf } from "../parts/words.js";

const LIMITS = "battery limits"; // by component, in the unit that it reports
const METRICS = ["web/liveness", "web/estop", "web/driver", "autonomy-status", "status", "charging-level", "charging-status"];
const SIGNS = { offline: "✖", online: "●", stop: "■", battery: "▲", script: "✖", service: "▲", undriveable: "▲", driveable: "●", asks: "?" };

/** Follows all components, from when it is made. */
class NoticeModel extends Model {
  constructor({ driver, store, connection }) {
    super();
    this.driver = driver;
    this.store = store;
    this.connection = connection;
    this.notices = new Notices();
    this.watcher = new Watcher(this.notices);
    const limits = read(LIMITS, {});
    this.limits = isObject(limits) ? limits : {};
    /** @type {Map<string, (() => void)[]>} */
    this.followed = new Map();
    store.subscribe(null, null, () => this.join());
    this.join();
  }

  /** Follow the components that there are. */
  join() {
    const refs = new Set(this.store.refs());
    for (const [ref, ends] of this.followed) {
      if (refs.has(ref)) continue;
      ends.forEach((end) => end());
      this.followed.delete(ref);
    }
    for (const ref of refs) {
      if (this.followed.has(ref)) continue;
      this.followed.set(
        ref,
        METRICS.map((metric) => this.store.subscribe(ref, metric, () => this.see(ref, metric))),
      );
      METRICS.forEach((metric) => this.see(ref, metric));
    }
  }

  /** @param {string} ref @param {string} metric that has changed */
  see(ref, metric) {
    const value = (name) => this.store.get(ref, name)?.value;
    const before = this.notices.list;
    const now = this.store.now();
    switch (metric) {
      case "web/liveness":
        this.watcher.online(ref, value(metric)?.online, now);
        break;
      case "web/estop":
        this.watcher.stop(ref, value(metric), now);
        break;
      case "web/driver":
        if (ref !== this.driver.ref) this.watcher.asked(ref, value(metric), now); // else the page shows it
        break;
      case "autonomy-status":
        this.watcher.script(ref, value(metric), now);
        break;
      case "status":
        this.watcher.services(ref, inner(value(metric))?.services, now);
        this.watcher.driveable(ref, inner(value(metric))?.driveable, this.isDriven(ref), now);
        break;
      default:
        this.battery(ref, value("charging-level"), value("charging-status"), now);
    }
    if (this.notices.list !== before) this.tally();
  }

  isDriven(ref) {
    const value = (name) => this.store.get(ref, name)?.value;
    return Boolean(value("web/driver")?.by || value("autonomy-status")?.running);
  }

  battery(ref, level, status, now) {
    const unit = isObject(level) && typeof level.unit === "string" ? level.unit : "";
    const limit = this.limit(ref);
    const charging = inner(status) === true;
    this.watcher.battery(ref, { value: inner(level), unit: unit === "v" ? "V" : unit, charging, limit }, now);
  }

  /** @param {string} ref @returns {number | null} */
  limit(ref) {
    const limit = Object.hasOwn(this.limits, ref) ? this.limits[ref] : null;
    return Number.isFinite(limit) ? limit : null;
  }

  /** @param {string} ref @param {number | null} limit */
  setLimit(ref, limit) {
    const { [ref]: _, ...others } = this.limits;
    this.limits = limit === null ? others : { ...others, [ref]: limit };
    write(LIMITS, this.limits);
    this.see(ref, "charging-level");
    this.changed();
  }

  read() {
    if (!this.notices.unread) return;
    this.notices.read();
    this.tally();
  }

  clear() {
    this.notices.clear();
    this.tally();
  }

  tally() {
    this.connection.unread = this.notices.unread;
    this.connection.changed();
    this.changed();
  }
}

const models = new WeakMap();

/** @returns {NoticeModel} */
function useNotices() {
  const page = usePage();
  if (!models.has(page)) models.set(page, new NoticeModel(page));
  return useModel(models.get(page));
}

/** ``wide``: there is room for a button, else the list is with the settings; ``room``: for the recordings' link, too. */
export function Bell({ at, wide, room = wide }) {
  const { panels } = usePage();
  const { shown } = useModel(panels);
  const { notices } = useNotices();
  const { unread } = notices;
  const [open, show] = useState(false);
  useEffect(() => {
    if (shown) show(false);
  }, [shown]);
  const toggle = () => {
    if (!open) panels.show("");
    show(!open);
  };
  return html`<${Announcement} notices=${notices} list=${notices.list} />
    ${at && html`<${DoubtMark} at=${at} />`}
    ${room && at && html`<${RecordingsLink} at=${at} className="button quiet" />`}
    ${wide &&
    html`<button
      type="button"
      class="quiet bell"
      data-test="bell"
      aria-expanded=${open}
      aria-label=${unread ? `Notices, ${unread} new` : "Notices"}
      onClick=${toggle}
    >
      <${Icon} name="bell" />${unread > 0 && html`<b class="unread" aria-hidden="true">${unread}</b>`}
    </button>`}
    ${wide &&
    open &&
    html`<${Panel} id="notices" title="Notices" onClose=${() => show(false)}>
      <${NoticeList} onGo=${() => show(false)} />
    <//>`}`;
}

/** What came since the last time is read aloud, at most once a second. Of the component that is open the banners are read. */
function Announcement({ notices, list }) {
  const { route, store } = usePage();
  const [text, say] = useState("");
  const changedAt = useRef(-Infinity);
  const banner = ({ ref, kind }) => ref === route.ref && ["offline", "stop", "undriveable"].includes(kind);
  useEffect(() => {
    const waiting = list.filter((one) => one.number > notices.announced && one.unread && !banner(one));
    if (!list.some((one) => one.unread)) say("");
    if (!waiting.length) return undefined;
    const timer = setTimeout(
      () => {
        changedAt.current = performance.now();
        notices.announced = list[0].number;
        say(aloud(waiting, (ref) => nameIn(store, ref)));
      },
      Math.max(0, changedAt.current + 1000 - performance.now()),
    );
    return () => clearTimeout(timer);
  }, [list, route.ref]);
  return html`<span class="sr" role="status" data-test="announcement">${text}</span>`;
}

export function NoticeList({ onGo }) {
  const model = useNotices();
  const { list } = model.notices;
  const [unread] = useState(() => new Set(list.filter((one) => one.unread).map((one) => one.key)));
  useEffect(() => model.read(), [list]);
  return html`<div class="notices">
    ${list.length
      ? html`<ul data-test="notices">
          ${list.map((one) => html`<${Row} key=${one.key} one=${one} isNew=${unread.has(one.key)} onGo=${onGo} />`)}
        </ul>`
      : html`<p class="dim">Nothing to tell since this page was opened.</p>`}
    ${list.length > 0 &&
    html`<button type="button" data-test="clear-notices" onClick=${() => model.clear()}>Clear the list</button>`}
    <${Limits} model=${model} />
  </div>`;
}

function Row({ one, isNew, onGo }) {
  const { ref, kind, text, at, since, count } = one;
  return html`<li class=${`notice notice-${kind} ${isNew ? "notice-new" : ""}`} onClick=${onGo}>
    <${RouteLink} to=${ref} className="notice-link">
      <i aria-hidden="true">${SIGNS[kind]}</i>
      <span class="notice-text">
        <b>${useName(ref)}</b> ${text}${count > 1 && html` <small>${count}× since ${shortTime(since)}</small>`}
      </span>
      <time>${shortTime(at)}</time>
    <//>
  </li>`;
}

const MOST_LIMITS = 50;

function Limits({ model }) {
  const { store } = usePage();
  const refs = useRefs()
    .filter((ref) => store.get(ref, "charging-level"))
    .sort();
  if (!refs.length) return null;
  return html`<details class="limits">
    <summary data-test="limits">Warn of a low battery</summary>
    <p class="dim">Below 20 % by itself. What voltage is low depends on the battery: set it for each robot.</p>
    <ul>
      ${refs.slice(0, MOST_LIMITS).map((ref) => html`<${Limit} key=${ref} at=${ref} model=${model} />`)}
    </ul>
  </details>`;
}

function Limit({ at, model }) {
  const level = useValue(at, "charging-level");
  const set = (text) => {
    const limit = text === "" ? null : Number(text);
    model.setLimit(at, limit !== null && Number.isFinite(limit) ? limit : null);
  };
  return html`<li>
    <label class="limit"
      ><span>${useName(at)} <small>now ${battery(level)}</small></span
      ><span>below</span
      ><${Typed}
        type="number"
        step="any"
        data-test=${`limit-${nameOf(at)}`}
        placeholder="off"
        value=${model.limit(at) ?? ""}
        onDone=${set}
    /></label>
  </li>`;
}

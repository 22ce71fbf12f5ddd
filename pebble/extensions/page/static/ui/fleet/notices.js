// What an operator of many robots should learn without looking at each: a bell in the header, and its list.

import { Notices, aloud } from "../../core/notices.js";
import { DoubtMark } from "./doubt.js";
import { html, useCalm, useEffect, useModel, usePage, useState } from "../parts/hooks.js";
import { Model } from "../parts/models.js";
import { Panel } from "../panels/panel.js";
import { charge, looksOf, nameIn } from "../parts/looks.js";
import { Button, RouteLink, useName } from "../parts/parts.js";
import { RecordingsLink } from "./recordings-link.js";
import { shortTime } from "../parts/more-words.js";
import { inner } from "../parts/words.js";

const METRICS = ["web/liveness", "web/estop", "web/driver", "autonomy-status", "status", "charging-level"];
const SIGNS = { offline: "✖", online: "●", stop: "■", battery: "▲", script: "✖", service: "▲", undriveable: "▲", driveable: "●", asks: "?" };

/** Follows all components, from when it is made. */
class NoticeModel extends Model {
  constructor({ driver, store, connection }) {
    super();
    this.driver = driver;
    this.store = store;
    this.connection = connection;
    this.notices = new Notices();
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
      this.notices.states.delete(ref);
    }
    for (const ref of refs) {
      if (this.followed.has(ref)) continue;
      const see = (metric) => this.see(ref, metric);
      this.followed.set(ref, METRICS.map((metric) => this.store.subscribe(ref, metric, () => see(metric))));
      METRICS.forEach(see);
    }
  }

  /** @param {string} ref @param {string} metric that has changed */
  see(ref, metric) {
    const value = (name) => this.store.get(ref, name)?.value;
    const before = this.notices.list;
    const tell = (event, ...given) => this.notices.see(ref, event, this.store.now(), ...given);
    if (metric === "web/liveness") tell("presence", value(metric)?.online);
    else if (metric === "web/estop") tell("stop", value(metric));
    else if (metric === "autonomy-status") tell("script", value(metric));
    else if (metric === "charging-level") {
      tell("battery", charge(value(metric), looksOf(ref, value("capabilities")).cells), inner(value("charging-status")) === true);
    } else if (metric === "status") {
      tell("service", inner(value(metric))?.services);
      tell("driveable", inner(value(metric))?.driveable, Boolean(value("web/driver")?.by || value("autonomy-status")?.running));
    } else if (ref !== this.driver.ref) tell("asks", value(metric)); // else the page shows it
    if (this.notices.list !== before) this.tally();
  }

  read() {
    if (!this.notices.unread) return;
    this.notices.read();
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
  return html`<${Announcement} notices=${notices} />
    ${at && html`<${DoubtMark} at=${at} />`}
    ${room && at && html`<${RecordingsLink} at=${at} className="button quiet" />`}
    ${wide &&
    html`<${Button}
      className="quiet bell"
      test="bell"
      label=${unread ? `Notices, ${unread} new` : "Notices"}
      aria-expanded=${open}
      icon="bell"
      onPress=${toggle}
    >
      ${unread > 0 && html`<b class="unread" aria-hidden="true">${unread}</b>`}
    <//>`}
    ${wide &&
    open &&
    html`<${Panel} id="notices" title="Notices" onClose=${() => show(false)}>
      <${NoticeList} onGo=${() => show(false)} />
    <//>`}`;
}

/** What came since the last time is read aloud, at most once a second. Of the component that is open the banners are read. */
function Announcement({ notices }) {
  const { route, store } = usePage();
  const isBanner = ({ ref, kind }) => ref === route.ref && ["offline", "stop", "undriveable"].includes(kind);
  const { fresh } = notices;
  const text = notices.unread ? aloud(fresh.filter((notice) => !isBanner(notice)), (ref) => nameIn(store, ref)) : "";
  const said = useCalm(text);
  useEffect(() => {
    if (said === text) notices.fresh = notices.fresh.filter((notice) => !fresh.includes(notice));
  }, [said, text]);
  return html`<span class="sr" role="status" data-test="announcement">${said}</span>`;
}

export function NoticeList({ onGo }) {
  const model = useNotices();
  const { list } = model.notices;
  useEffect(() => model.read(), [list]);
  if (!list.length) return html`<div class="notices"><p class="dim">No notices yet</p></div>`;
  return html`<ul class="notices" data-test="notices">
    ${list.map((notice) => html`<${Row} key=${notice.ref} notice=${notice} onGo=${onGo} />`)}
  </ul>`;
}

function Row({ notice: { ref, kind, text, at }, onGo }) {
  return html`<li class=${`notice notice-${kind}`} onClick=${onGo}>
    <${RouteLink} to=${ref} className="notice-link">
      <i aria-hidden="true">${SIGNS[kind]}</i>
      <span><b>${useName(ref)}</b> ${text}</span>
      <time>${shortTime(at)}</time>
    <//>
  </li>`;
}

// All components at a glance: who is there, who drives, what is stopped.

import { ROOT } from "../../core/browser.js";
import { doubtOf } from "./doubt.js";
import { Liveness } from "../header.js";
import {
  Boundary,
  html,
  useEffect,
  useMetric,
  useModel,
  usePage,
  useRef,
  useRefs,
  useState,
  useTick,
  useValue,
} from "../parts/hooks.js";
import { Offers, Route, WATCHES } from "../parts/models.js";
import { charging, plain, shortTime } from "../parts/more-words.js";
import { Icon, Live, RouteLink, StopButton } from "../parts/parts.js";
import { RecordingsLink } from "./recordings-link.js";
import { battery, clockTime, driverName, inner, isObject, kindOf, nameOf, roughly, typeOf, visible } from "../parts/words.js";

const THUMBNAIL_MS = 1000;
const SORTS = { name: "name", type: "type", battery: "battery" };

export function Fleet() {
  const { connection, settings, store } = usePage();
  useModel(connection, (one) => one.state);
  useModel(settings);
  useTick(1000); // robots come and go
  const refs = useRefs();
  const omitted = useValue("", "web/broker")?.robots_omitted ?? 0;
  const [filter, setFilter] = useState("");
  const cards = useNodes(
    (ref) => html`<li key=${ref}><${Boundary} what=${nameOf(ref)}><${FleetCard} at=${ref} /><//></li>`,
  );
  const online = refs.filter((ref) => isPresent(store, ref));
  const away = refs.filter((ref) => !isPresent(store, ref) && !settings.forgotten.has(ref));
  useEffect(() => {
    online.forEach((ref) => settings.forgotten.has(ref) && settings.forget(ref, false));
  }, [online.join()]);
  const matches = (ref) => ref.toLowerCase().includes(filter.trim().toLowerCase());
  const shown = sorted(store, online.filter(matches), settings.sort);
  const shownAway = away.filter(matches).sort();
  const total = online.length + away.length;
  const robots = refs.filter((ref) => typeOf(ref) === "robots" && (online.includes(ref) || away.includes(ref)));
  const present = robots.filter((ref) => online.includes(ref));
  const others = total - robots.length;
  return html`<div class="fleet">
    <div class="fleet-head">
      <h1>
        ${total === 0
          ? "Robots"
          : `${robots.length} ${robots.length === 1 ? "robot" : "robots"}${connection.isOpen ? `, ${present.length} online` : ""}`}
        ${others > 0 && html`<span class="dim"> and ${others} ${others === 1 ? "other" : "others"}</span>`}
      </h1>
      ${total > 0 ? html`<${FleetTools} filter=${filter} onFilter=${setFilter} />` : html`<${RecordingsLink} />`}
    </div>
    ${omitted > 0 &&
    html`<p class="dim" data-test="omitted">
      Too much is sent at this broker: ${omitted} messages of further components, or values, are not shown. STOP ALL
      reaches all.
    </p>`}
    ${total === 0 && html`<${Empty} />`}
    ${total > 0 && !shown.length && !shownAway.length && html`<p class="empty">Nothing matches “${filter}”.</p>`}
    <ul class="fleet-cards">
      ${cards(shown)}
    </ul>
    ${shownAway.length > 0 &&
    html`<section class="away" aria-labelledby="away-title">
      <h2 id="away-title">Offline</h2>
      <ul>
        ${shownAway.map((ref) => html`<${AwayRow} key=${ref} at=${ref} />`)}
      </ul>
    </section>`}
  </div>`;
}

/** Components of which it is not yet known whether they are there are shown as cards, too. */
function isPresent(store, ref) {
  const view = store.get(ref, "web/liveness");
  if (!view) return true;
  return view.value.online === true || (view.value.online === null && view.value.silent_s !== null);
}

function sorted(store, refs, by) {
  const level = (ref) => {
    const value = inner(store.get(ref, "charging-level")?.value);
    return typeof value === "number" ? value : Infinity;
  };
  const robotsFirst = (ref) => `${typeOf(ref) === "robots" ? 0 : 1} ${nameOf(ref)}`;
  const keys = { name: robotsFirst, type: (ref) => `${typeOf(ref)} ${nameOf(ref)}`, battery: level };
  const key = keys[by] ?? robotsFirst;
  return [...refs].sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : a < b ? -1 : 1));
}

function FleetTools({ filter, onFilter }) {
  const { panels, settings } = usePage();
  return html`<div class="fleet-tools">
    <input
      type="search"
      data-test="filter"
      placeholder="Filter"
      aria-label="Filter by name"
      value=${filter}
      onInput=${(event) => onFilter(event.currentTarget.value)}
    />
    <label class="field"
      ><span>Sort by</span>
      <select
        data-test="sort"
        aria-label="Sort by"
        value=${settings.sort}
        onChange=${(event) => settings.set("sort", event.currentTarget.value)}
      >
        ${Object.entries(SORTS).map(([value, text]) => html`<option key=${value} value=${value}>${text}</option>`)}
      </select></label
    >
    ${!WATCHES &&
    html`<label class="check"
      ><input
        type="checkbox"
        data-test="thumbnails"
        checked=${settings.thumbnails}
        onChange=${(event) => settings.set("thumbnails", event.currentTarget.checked)}
      /><span>Thumbnails</span></label
    >`}
    <a class="button" data-test="watch" href=${Route.path("", !WATCHES)}>${WATCHES ? "Show all controls" : "Only watch"}</a>
    <${RecordingsLink} />
    <button type="button" class="to-phone" data-test="phone" onClick=${() => panels.show("phone")}>
      <${Icon} name="phone" />Open on a phone
    </button>
  </div>`;
}

function Empty() {
  const { connection } = usePage();
  return html`<div class="empty">
    <${Icon} name="robot" />
    <p>
      ${connection.state === "open"
        ? "No robot has been seen yet. It appears here as soon as it is switched on and reaches the broker."
        : "Connecting to the server…"}
    </p>
  </div>`;
}

const ICONS = { robots: "robot", towers: "tower", satellites: "satellite", people: "person" };

/** @param {string} ref @returns {string} the icon of its type */
export const iconOf = (ref) => ICONS[typeOf(ref)] ?? "thing";

const TRANSPORTS = { mqtt: "MQTT", zenoh: "Zenoh", mcu: "MCU" };

/** A service that is not well: its page has the rest. */
function ServiceFact({ at }) {
  const services = inner(useValue(at, "status"))?.services;
  if (!isObject(services)) return null;
  const ill = Object.keys(services).filter((name) => ["failed", "restarting"].includes(services[name]?.state));
  if (!ill.length) return null;
  const words = `${ill[0].replaceAll("_", " ")} ${services[ill[0]].state}`;
  return html`<${Told} sign="▲" className="bad">${words}<//>`;
}

/** What is said in a sentence, with its sign before all of its lines. */
const Told = ({ sign, className, children }) =>
  html`<li class=${`fact told ${className}`}><span aria-hidden="true">${sign}</span><span>${children}</span></li>`;

/** Whether its motors obey. */
function DoubtFact({ at }) {
  const { no, text } = doubtOf(useValue(at, "status"));
  return text ? html`<${Told} sign=${no ? "▲" : "?"} className=${no ? "bad" : "dim"}>${text}<//>` : null;
}

function FleetCard({ at }) {
  const { commands, settings, connection } = usePage();
  useModel(settings);
  useModel(connection, (one) => one.state);
  const offers = new Offers(at, useValue(at, "capabilities"));
  const estop = useValue(at, "web/estop");
  const picture = useValue(at, "web/picture");
  const kind = TRANSPORTS[offers.transport] ?? offers.transport;
  const name = nameOf(at);
  return html`<article
    class=${`fleet-card ${estop?.latched ? "is-stopped" : ""}`}
    data-test=${`card-${name}`}
    aria-label=${name}
  >
    <div class="fleet-card-head">
      <span class="badge"><${Icon} name=${iconOf(at)} /></span>
      <div class="fleet-card-name">
        <h2>${name}</h2>
        <span class="dim">${[kindOf(at), kind].filter(Boolean).join(" · ")}</span>
      </div>
      <${Liveness} at=${at} />
    </div>
    ${(settings.thumbnails || WATCHES) &&
    (offers.hasVideo
      ? html`<${Thumbnail} at=${at} picture=${picture} />`
      : typeOf(at) === "robots" && html`<div class="thumbnail">no camera</div>`)}
    <ul class="facts">
      <${BatteryFact} at=${at} online=${connection.isOpen} />
      ${connection.isOpen && html`<${DoubtFact} at=${at} />`}
      <${DriverFact} at=${at} offers=${offers} online=${connection.isOpen} stopped=${estop?.latched} />
      <${ScriptFact} at=${at} online=${connection.isOpen} />
      ${typeOf(at) !== "robots" ? html`<${StatusFact} at=${at} />` : html`<${ServiceFact} at=${at} />`}
      ${estop?.latched &&
      html`<li class="fact bad">
        <span aria-hidden="true">■</span><b>STOPPED</b>${estop.by ? ` by ${estop.by}` : ""}
        ${estop.since > 0 ? ` ${clockTime(estop.since)}` : ""}
      </li>`}
    </ul>
    <div class="fleet-card-actions">
      <${RouteLink} to=${at} className="button primary" label=${`Open ${name}`}>Open<//>
      ${offers.stops &&
      html`<${StopButton}
        test=${`stop-${name}`}
        onStop=${() => commands.stop(at)}
        label=${`Stop: emergency stop of ${name}`}
        className="stop-small"
      >
        <${Icon} name="stop" />Stop
      <//>`}
    </div>
  </article>`;
}

function BatteryFact({ at, online }) {
  const level = useMetric(at, "charging-level");
  const status = useValue(at, "charging-status");
  if (!level && !status) return null;
  const isCharging = status?.value === true;
  return html`<li class="fact">
    <${Icon} name=${isCharging ? "charging" : "battery"} />
    ${level && html`<${Live} entry=${level} online=${online}>${battery(level.value)}<//>`}
    ${status && html`<span class="dim">${charging(status)}</span>`}
  </li>`;
}

function DriverFact({ at, offers, online, stopped }) {
  const view = useValue(at, "web/driver");
  const doubt = doubtOf(useValue(at, "status")).text;
  if (!online) return null;
  if (!offers.known && !offers.drives) return null;
  if (!offers.drives) return html`<li class="fact dim"><${Icon} name="wheel" />does not drive</li>`;
  if (!view?.by) return stopped || doubt ? null : html`<li class="fact dim"><${Icon} name="wheel" />free to drive</li>`;
  return html`<li class="fact">
    <${Icon} name="wheel" />${view.you ? html`<b>driven by you</b>` : `driven by ${driverName(view)}`}
  </li>`;
}

function ScriptFact({ at, online }) {
  const status = useValue(at, "autonomy-status");
  if (!online || !status?.running) return null;
  return html`<li class="fact"><${Icon} name="script" />script: ${plain(status.file ?? "?")}${status.waiting_for ? ", waiting" : ""}</li>`;
}

/** In a word or two, what a component reports that is no robot. */
function StatusFact({ at }) {
  const status = inner(useValue(at, "status"));
  if (!isObject(status)) return null;
  return html`<li class="fact dim">${plain(Object.fromEntries(Object.entries(status).slice(0, 3)))}</li>`;
}

/** One picture a second of what flows anyway: this never starts a camera. */
function Thumbnail({ at, picture }) {
  const flowing = picture?.state === "flowing";
  const [count, setCount] = useState(0);
  useEffect(() => {
    if (!flowing) return undefined;
    const timer = setInterval(() => document.hidden || setCount((n) => n + 1), THUMBNAIL_MS);
    return () => clearInterval(timer);
  }, [flowing]);
  if (!flowing) {
    return html`<div class="thumbnail"><${Icon} name="camera" />camera rests</div>`;
  }
  return html`<div class="thumbnail">
    <img alt=${`What ${visible(nameOf(at))} sees`} src=${`${ROOT}api/snapshot.jpg?ref=${encodeURIComponent(at)}&n=${count}`} />
  </div>`;
}

function AwayRow({ at }) {
  const { settings, store } = usePage();
  const liveness = useMetric(at, "web/liveness");
  const heartbeat = useValue(at, "online");
  const level = useMetric(at, "charging-level");
  const silent = liveness?.value?.silent_s;
  const seen =
    typeof silent === "number"
      ? store.now() - 1000 * silent - liveness.age
      : Number.isFinite(heartbeat?.t)
        ? heartbeat.t
        : null;
  const since = seen === null ? "never seen" : `last seen ${shortTime(seen)} (${roughly(store.now() - seen)} ago)`;
  return html`<li class="away-row">
    <span class="badge dim"><${Icon} name=${iconOf(at)} /></span>
    <span class="away-name"
      ><${RouteLink} to=${at}>${nameOf(at)}<//> <span class="dim">${since}</span> ${level &&
      html`<span class="dim">${battery(level.value)} then</span>`}</span
    >
    <button
      type="button"
      data-test="forget"
      aria-label=${`Forget ${nameOf(at)}`}
      onClick=${() => settings.forget(at)}
    >
      Forget
    </button>
  </li>`;
}

/**
 * Draw each item again only when it changes by itself: Preact passes over a node that it has drawn before. ``draw`` may
 * use nothing but its argument.
 * @param {(ref: string) => any} draw @returns {(refs: string[]) => any[]}
 */
function useNodes(draw) {
  const nodes = useRef(new Map());
  return (refs) => {
    const old = nodes.current;
    nodes.current = new Map(refs.map((ref) => [ref, old.get(ref) ?? draw(ref)]));
    return [...nodes.current.values()];
  };
}

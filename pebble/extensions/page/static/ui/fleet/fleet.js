// All components at a glance: who is there, who drives, what is stopped.

import { ROOT } from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { doubtOf } from "./doubt.js";
import { Bands, progressOf } from "../banner.js";
import { Liveness } from "../header.js";
import {
  Boundary,
  html,
  useEffect,
  useMetric,
  useModel,
  usePage,
  useRecent,
  useRef,
  useRefs,
  useState,
  useTick,
  useValue,
} from "../parts/hooks.js";
import { Offers, Route, WATCHES } from "../parts/models.js";
import { LOW_PERCENT, charge, hasFace, looksOf, nameIn } from "../parts/looks.js";
import { plain, shortTime } from "../parts/more-words.js";
import { Button, Charge, Check, Drawing, Drop, Icon, RouteLink, Select, StopButton, useItself } from "../parts/parts.js";
import { RecordingsLink } from "./recordings-link.js";
import { battery, driverName, inner, isObject, kindOf, nameOf, roughly, typeOf } from "../parts/words.js";

const STILL_MS = 5000; // between two of a camera that is on
const LIVE_MS = 10_000; // a still that young is of now
const AGE_MS = 10_000; // the step in which the age of an older one is told: each costs a frame
const DENSE = 13; // so many components are shown in small cards, and by what they need
const MANY = 100; // beyond, cards have no pictures, and only those near the screen are drawn
const NEEDS_MS = 10_000; // so long a card stays among those that need a look
const SORTS = { name: "By name", battery: "By battery" }; // of small cards
const ILL = ["failed", "restarting"]; // services
const isRobot = (ref) => typeOf(ref) === "robots";

const kept = { filter: "" }; // while a robot is looked at

export function Fleet() {
  const { connection, settings, store } = usePage();
  useModel(connection, (one) => one.state);
  useModel(settings);
  useTick(1000); // robots come and go
  const refs = useRefs();
  const { robots_omitted: omitted = 0, stops_omitted: unconfirmed = false } = useValue("", "web/broker") ?? {};
  const [filter, setFilter] = useState(kept.filter);
  kept.filter = filter;
  const present = new Set(refs.filter((ref) => isPresent(store, ref)));
  const online = [...present];
  const away = refs.filter((ref) => !present.has(ref) && !settings.forgotten.has(ref));
  useEffect(() => {
    online.forEach((ref) => settings.forgotten.has(ref) && settings.forget(ref, false));
  }, [online.join()]);
  const matches = matcher(store, filter);
  const shownAway = away.filter(matches).sort();
  const total = online.length + away.length;
  const robots = [...online, ...away].filter(isRobot);
  const there = robots.filter((ref) => present.has(ref));
  const dense = total >= DENSE;
  const shown = sorted(store, online.filter(matches), dense && settings.sort === "battery");
  const many = total > MANY;
  const needing = useNeeding(store, dense ? shown : []);
  const groups = [
    { title: dense ? "Need a look" : "", list: shown.filter((ref) => dense ? needing.has(ref) : isRobot(ref)) },
    { title: dense ? "Online" : "Others", list: shown.filter((ref) => dense ? !needing.has(ref) : !isRobot(ref)) },
  ].filter(({ list }) => list.length);
  return html`<div class="fleet">
    <div class="fleet-head">
      <div class="screen-title">
        <h1>
        ${total === 0
          ? "Robots"
          : `${robots.length} ${robots.length === 1 ? "robot" : "robots"}${connection.isOpen && away.some(isRobot) ? `, ${there.length} online` : ""}`}
        </h1>
        <${Bands} at="" />
      </div>
      ${total > 0 ? html`<${FleetTools} filter=${filter} onFilter=${setFilter} dense=${dense} many=${many} />` : html`<${RecordingsLink} />`}
    </div>
    ${omitted > 0 &&
    html`<p class="dim" data-test="omitted">
      Too much is sent at this broker: beside these ${total}, ${omitted} messages of further components, or values, are
      not shown. STOP ALL reaches all. Give the broker accounts.
    </p>`}
    ${unconfirmed &&
    html`<p role="alert" data-test="stops-omitted">
      There are more robots or stops than fit: the others got the stop, NOT CONFIRMED.
    </p>`}
    ${total === 0 && html`<${Empty} />`}
    ${total > 0 && !shown.length && !shownAway.length && html`<p class="empty">Nothing matches “${filter}”.</p>`}
    ${groups.map(({ title, list }) => html`<${Group} key=${title} title=${title} dense=${dense} plain=${many} refs=${list} />`)}
    ${total > 0 && !dense && !WATCHES && html`<${FirstTime} refs=${there} />`}
    ${shownAway.length > 0 &&
    html`<section class="away" aria-labelledby="away-title">
      <h2 id="away-title">Offline</h2>
      <ul class=${many ? "many" : ""}>
        ${shownAway.map((ref) => html`<${Item} key=${ref} at=${ref} many=${many} draw=${rowOf} />`)}
      </ul>
    </section>`}
  </div>`;
}

/** Whether all words are found in what is known of a component. @returns {(ref: string) => boolean} */
function matcher(store, filter) {
  const words = filter.toLowerCase().split(/\s+/).filter(Boolean);
  const value = (ref, metric) => store.get(ref, metric)?.value;
  const text = (ref) => {
    const { name, description } = looksOf(ref, value(ref, "capabilities"));
    const is = [isPresent(store, ref) ? "online" : "offline", value(ref, "web/estop")?.latched ? "stopped" : ""];
    return [ref, name, description, value(ref, "web/driver")?.by, ...is].join(" ").toLowerCase();
  };
  return (ref) => !words.length || ((all) => words.every((word) => all.includes(word)))(text(ref));
}

/** Components of which it is not yet known whether they are there are shown as cards, too. */
function isPresent(store, ref) {
  const view = store.get(ref, "web/liveness");
  if (!view) return true;
  return view.value.online === true || (view.value.online === null && view.value.silent_s !== null);
}

/** Robots first, by name; or first those with the least in their batteries. */
function sorted(store, refs, byBattery) {
  const level = (ref) => byBattery ? percentOf(store, ref) ?? Infinity : 0;
  const keyed = refs.map((ref) => ({ ref, level: level(ref), name: `${isRobot(ref) ? 0 : 1} ${nameIn(store, ref).toLowerCase()} ${ref}` }));
  keyed.sort((a, b) => (a.level !== b.level ? a.level - b.level : a.name < b.name ? -1 : 1));
  return keyed.map(({ ref }) => ref);
}

/** @returns {number | null} of its battery; null: unknown */
const percentOf = (store, ref) =>
  charge(store.get(ref, "charging-level")?.value, looksOf(ref, store.get(ref, "capabilities")?.value).cells);

/** Those which a person should look at: at once, and for a while after the reason is gone. @returns {Set<string>} */
function useNeeding(store, refs) {
  const since = useRef(new Map());
  const now = performance.now();
  for (const ref of refs) if (needs(store, ref)) since.current.set(ref, now);
  return new Set(refs.filter((ref) => now - (since.current.get(ref) ?? -Infinity) < NEEDS_MS));
}

function needs(store, ref) {
  const percent = percentOf(store, ref);
  const charges = store.get(ref, "charging-status")?.value?.value === true;
  return (
    store.get(ref, "web/estop")?.value.latched === true ||
    doubtOf(store.get(ref, "status")?.value).no ||
    (percent !== null && percent < LOW_PERCENT && !charges)
  );
}

function FleetTools({ filter, onFilter, dense, many }) {
  const { panels, settings } = usePage();
  return html`<div class="fleet-tools">
    <input
      type="search"
      data-test="filter"
      placeholder="Filter"
      aria-label="Filter by name, driver or state"
      value=${filter}
      onInput=${(event) => onFilter(event.currentTarget.value)}
    />
    ${dense &&
    html`<${Select} test="sort" label="Sort" value=${settings.sort} choices=${Object.entries(SORTS)} onChoose=${(by) => settings.set("sort", by)} />`}
    <${RecordingsLink} />
    <${Drop} test="fleet-more" look="button" summary="More">
        <${Button} test="phone" icon="phone" onPress=${() => panels.show("phone")}>Open on a phone<//>
        ${!WATCHES &&
        !many &&
        html`<${Check} test="thumbnails" checked=${settings.thumbnails} onChange=${(on) => settings.set("thumbnails", on)}>Thumbnails<//>`}
        <a class="button" data-test="watch" href=${Route.path("", !WATCHES)}
          >${WATCHES ? "Show all controls" : "Only watch"}</a
        >
    <//>
  </div>`;
}

/** What one can do in the first minutes; each is ticked when it was done. */
function FirstTime({ refs }) {
  const { connection, panels, settings, store } = usePage();
  useModel(settings);
  useModel(connection, (one) => one.you);
  if (settings.begun.includes("hidden")) return null;
  const robots = refs.map((ref) => ({ ref, name: nameIn(store, ref), offers: new Offers(ref, store.get(ref, "capabilities")?.value) }));
  const runs = ({ offers }) => Boolean(offers.section("autonomy").available);
  const worth = (robot) => 2 * Number(robot.offers.hasVideo) + Number(runs(robot));
  const [drives] = robots.filter(({ offers }) => offers.drives).sort((a, b) => worth(b) - worth(a));
  if (!drives) return null;
  const scripts = runs(drives) ? drives : robots.find(runs);
  const items = [
    ["drive", `Drive ${drives.name}`, { to: drives.ref }],
    scripts && ["script", `Let ${scripts.name} drive itself`, { to: scripts.ref }],
    connection.you?.recordings && ["recordings", "Watch what just happened", { path: `${ROOT}replay` }],
  ].filter(Boolean);
  const number = (name, at) => html`<span class=${`step ${settings.begun.includes(name) ? "done" : ""}`}
    >${settings.begun.includes(name) ? html`<${Icon} name="check" />` : at}</span
  >`;
  return html`<section class="first-time" aria-labelledby="first-time" data-test="first-time">
    <div class="first-time-head">
      <h2 id="first-time">First time here?</h2>
      <${Button} className="quiet" test="hide-first-time" onPress=${() => settings.begin("hidden")}>Hide<//>
    </div>
    <ul>
      ${items.map(
        ([name, title, target], at) => html`<li key=${name}>
          <${RouteLink} ...${target} className="try">${number(name, at + 1)}<b>${title}</b><//>
        </li>`,
      )}
      <li>
        <${Button} className="try" onPress=${() => panels.show("phone")}>
          ${number("phone", items.length + 1)}<b>Open it on your phone</b>
        <//>
      </li>
    </ul>
  </section>`;
}

/** To a first robot. */
const WAYS = [
  ["Try simulated ones", "Four drive in a room of their own, at a broker of their own.", "make demo"],
  ["Start your robot", "Its config names this server's broker.", "pebble up my.json"],
  ["In any other language", "A retained message with its heartbeat makes it known here.", "pebble/robots/ID/outgoing/online"],
];

function Empty() {
  const { connection } = usePage();
  return html`<div class="empty">
    <${Icon} name="robot" />
    <p>
      ${connection.state === "open"
        ? "No robot has been seen yet. It appears here as soon as it is switched on and reaches the broker."
        : "Connecting to the server…"}
    </p>
    ${connection.state === "open" &&
    html`<ul class="ways">
      ${WAYS.map(([title, how, code]) => html`<li key=${title}><b>${title}</b><span class="dim">${how}</span><code>${code}</code></li>`)}
    </ul>`}
  </div>`;
}

const ICONS = { robots: "robot", towers: "tower", satellites: "satellite", people: "person" };

/** @param {string} ref @returns {string} the icon of its type */
export const iconOf = (ref) => ICONS[typeOf(ref)] ?? "thing";

/** Why its motors do not obey, or which service is not well: its page has the rest. */
function TroubleFact({ at }) {
  const status = useValue(at, "status");
  const { no, text } = doubtOf(status);
  const { services } = inner(status) ?? {};
  const [ill, { state }] = Object.entries(isObject(services) ? services : {}).find(([, one]) => ILL.includes(one?.state)) ?? ["", {}];
  const words = text || (ill && `${state}: ${ill.replaceAll("_", " ")}`);
  const bad = no || !text;
  return words && html`<li class=${`fact told ${bad ? "bad" : "dim"}`} title=${words}><span aria-hidden="true">${bad ? "▲" : "?"}</span><span>${words}</span></li>`;
}

/** On one line, which ends with dots where there is more. */
const Fact = ({ icon = "", className = "dim", children }) =>
  html`<li class=${`fact ${className}`}>${icon && html`<${Icon} name=${icon} />`}<span>${children}</span></li>`;

/** ``plain``: without a picture. @param {{at: string, plain?: boolean}} props */
function FleetCard({ at, plain }) {
  const { commands, settings, connection } = usePage();
  useModel(settings);
  useModel(connection, (one) => one.state);
  const capabilities = useValue(at, "capabilities");
  const offers = new Offers(at, capabilities);
  const looks = looksOf(at, capabilities);
  const estop = useValue(at, "web/estop");
  const id = nameOf(at);
  const what = hasFace(at) ? looks.description : kindOf(at);
  const pictured = (settings.thumbnails || WATCHES) && hasFace(at) && !plain;
  return html`<article
    class=${`fleet-card tint-${looks.colour} ${estop?.latched ? "is-stopped" : ""}`}
    data-test=${`card-${id}`}
    aria-label=${looks.name}
  >
    ${pictured && html`<${Thumbnail} at=${at} has=${offers.hasVideo} looks=${looks} />`}
    <div class="fleet-card-head">
      <${Badge} at=${at} looks=${looks} />
      <${RouteLink} to=${at} className="fleet-card-link">
        <h2>${looks.name}</h2>
        ${estop?.latched && !pictured ? html`<span class="bad">${stopWords(estop)}</span>` : html`<span class="dim">${what}</span>`}
      <//>
      <${Liveness} at=${at} />
    </div>
    <div class="fleet-card-foot">
      <ul class="facts">
        <${BatteryFact} at=${at} online=${connection.isOpen} />
        ${connection.isOpen && typeOf(at) === "robots" && html`<${TroubleFact} at=${at} />`}
        <${DriverFact} at=${at} offers=${offers} online=${connection.isOpen} estop=${estop} pictured=${pictured} />
        ${typeOf(at) !== "robots" && html`<${StatusFact} at=${at} />`}
      </ul>
      ${estop?.latched
        ? html`<${RouteLink} to=${at} className="button stop-small to-reset" label=${`Open to reset ${looks.name}`}>Open to reset<//>`
        : offers.stops &&
          html`<${StopButton}
            test=${`stop-${id}`}
            onStop=${() => commands.stop(at)}
            label=${`Stop: emergency stop of ${looks.name}`}
            className="stop-small"
          >
            <${Icon} name="stop" />Stop
          <//>`}
    </div>
  </article>`;
}

/** Over its picture: that it is stopped, or does not confirm it. */
function Stripe({ at }) {
  const estop = useValue(at, "web/estop");
  useTick(estop?.sending ? 500 : 0);
  const unconfirmed = progressOf(usePage().store, at)?.kind === "bad";
  const words = unconfirmed ? "STOP not confirmed" : estop?.latched ? stopWords(estop) : "";
  return words && html`<p class="stripe">${words}</p>`;
}

const stopWords = ({ by, since }) => `Stopped${by ? ` by ${by}` : ""}${since > 0 ? `, ${shortTime(since)}` : ""}`;

/** The face of a robot, or the icon of what is none. */
const Badge = ({ at, looks }) => html`<span class="badge"
  >${hasFace(at) ? html`<${Drawing} picture=${looks.picture} />` : html`<${Icon} name=${iconOf(at)} />`}</span
>`;

function BatteryFact({ at, online }) {
  const level = useMetric(at, "charging-level");
  const charges = useValue(at, "charging-status")?.value === true;
  if (!level && !charges) return null;
  return html`<li class="fact">
    <${Icon} name=${charges ? "charging" : "battery"} />
    ${level && html`<${Charge} at=${at} level=${level} online=${online} />`}
    ${charges && html`<span class="dim">charging</span>`}
  </li>`;
}

function DriverFact({ at, offers, online, estop, pictured }) {
  const view = useValue(at, "web/driver");
  const itself = useItself(at);
  if (!offers.drives) return null;
  if (!online) return html`<${Fact} icon="wheel">who drives is not known<//>`;
  if (estop?.latched) return pictured && html`<${Fact} icon="stop">reset it to drive<//>`;
  if (itself) return html`<${Fact} icon="script" className="told"><b>${itself}</b><//>`;
  if (!view?.by) return null;
  return html`<${Fact} icon="wheel" className="">${view.you ? html`<b>driven by you</b>` : `driven by ${driverName(view)}`}<//>`;
}

/** In a word or two, what a component reports that is no robot. */
function StatusFact({ at }) {
  const status = inner(useValue(at, "status"));
  if (!isObject(status)) return null;
  return html`<${Fact}>${plain(Object.fromEntries(Object.entries(status).slice(0, 3)))}<//>`;
}

/** The last picture, renewed while the camera is on anyway: this never starts it. ``has``: there is one; else the robot's face. */
function Thumbnail({ at, has, looks }) {
  const flows = useValue(at, "web/picture")?.state === "flowing";
  const runs = useValue(at, "media-status")?.camera_publisher?.running === true;
  const isOn = flows || runs;
  const [{ src, takenAt }, take] = useState({ src: "", takenAt: 0 });
  useEffect(() => {
    if (!has) return undefined;
    const look = async () => {
      const answer = document.hidden ? null : await fetch(`${ROOT}api/snapshot.jpg?ref=${encodeURIComponent(at)}`).catch(() => null);
      if (answer?.status !== 200) return;
      const age = 1000 * Number(answer.headers.get("age"));
      take({ src: URL.createObjectURL(await answer.blob()), takenAt: performance.now() - age });
    };
    look();
    const timer = setInterval(() => isOn && look(), STILL_MS);
    return () => clearInterval(timer);
  }, [at, has, isOn]);
  useEffect(() => () => URL.revokeObjectURL(src), [src]);
  const age = performance.now() - takenAt;
  const isLive = useRecent(takenAt, LIVE_MS) && isOn;
  useTick(src && !isLive ? AGE_MS : 0);
  return html`<div class=${`thumbnail ${src ? "" : "faced"}`}>
    ${src ? html`<img alt=${`What ${looks.name} sees`} src=${src} />` : html`<${Drawing} picture=${looks.picture} />`}
    ${src && html`<span class=${`tag ${isLive ? "live" : ""}`}>${isLive ? "live" : `${roughly(age - (age % AGE_MS))} ago`}</span>`}
    <${Stripe} at=${at} />
  </div>`;
}

function AwayRow({ at }) {
  const { settings, store } = usePage();
  const liveness = useMetric(at, "web/liveness");
  const heartbeat = useValue(at, "online");
  const level = useMetric(at, "charging-level");
  const looks = looksOf(at, useValue(at, "capabilities"));
  const silent = liveness?.value?.silent_s;
  const seen =
    typeof silent === "number"
      ? store.now() - 1000 * silent - liveness.age
      : Number.isFinite(heartbeat?.t)
        ? heartbeat.t
        : null;
  const since = seen === null ? "never seen" : `last seen ${shortTime(seen)} (${roughly(store.now() - seen)} ago)`;
  return html`<div class=${`away-row tint-${looks.colour}`}>
    <${Badge} at=${at} looks=${looks} />
    <span class="away-name"
      ><${RouteLink} to=${at}>${looks.name}<//> <span class="dim">${since}</span> ${level &&
      html`<span class="dim">${battery(level.value)} then</span>`}</span
    >
    <${Button} test="forget" label=${`Forget ${looks.name}`} onPress=${() => settings.forget(at)}>Forget<//>
  </div>`;
}

/**
 * One list of cards. Each card is drawn again only when it changes by itself: Preact passes over a node that it has drawn
 * before, in the same list.
 */
function Group({ title, dense, plain, refs }) {
  const cards = useRef(new Map());
  const old = cards.current;
  cards.current = new Map(refs.map((ref) => [ref, old.get(ref) ?? html`<${Item} key=${ref} at=${ref} many=${plain} draw=${cardOf} />`]));
  return html`<section aria-label=${title || "Robots"}>
    ${title && html`<h2 class="fleet-group">${title}</h2>`}
    <ul class=${`fleet-cards ${dense ? "dense" : ""} ${plain ? "many" : ""}`}>
      ${[...cards.current.values()]}
    </ul>
  </section>`;
}

/** A component in a list. Of ``many`` only those near the screen are drawn: all at once would hold up keys and STOP. */
function Item({ at, many, draw }) {
  const place = useRef(null);
  const [seen, see] = useState(!many);
  useEffect(() => {
    if (!many) return see(true);
    const sight = more.sight(see, "600px");
    sight.observe(place.current);
    return () => sight.disconnect();
  }, [many]);
  return html`<li ref=${place}>${seen && draw(at, many)}</li>`;
}

const cardOf = (ref, plain) => html`<${Boundary} what=${nameOf(ref)}><${FleetCard} at=${ref} plain=${plain} /><//>`;
const rowOf = (ref) => html`<${AwayRow} at=${ref} />`;

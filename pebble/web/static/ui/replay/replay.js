// Recordings: which day and robot, or one robot at one time, with the same cards as live.

import { firstPictureOf, startOf } from "../../core/replay/timeline.js";
import { CARDS } from "../cards/cards.js";
import {
  Boundary,
  Page,
  html,
  useEffect,
  useMetrics,
  useModel,
  usePage,
  useState,
  useTick,
  useValue,
} from "../parts/hooks.js";
import { CardView, Offers } from "../parts/models.js";
import { nameIn } from "../parts/looks.js";
import { Card, Icon, Part, RouteLink, useName } from "../parts/parts.js";
import { Choose, Elsewhere, timeWords } from "./choose.js";
import { Download } from "./download.js";
import { Replay as Model } from "./model.js";
import { Picture } from "./picture.js";
import { Sent, Sessions } from "./beside.js";
import { TimelineCard } from "./timeline.js";

const LEFT_OUT = ["voice"]; // it is for the live robot

export const Replay = ({ at }) => (at ? html`<${Opened} at=${at} />` : html`<${Choose} />`);

function Opened({ at }) {
  const live = usePage();
  const [replay, setReplay] = useState(/** @type {Model | null} */ (null));
  useEffect(() => {
    const made = new Model(live, at);
    setReplay(made);
    live.replay = made; // for tests, and for people who look into it
    live.driver.onSpace = () => made.toggle();
    const go = () => live.route.replay === at && start(made);
    addEventListener("popstate", go);
    document.addEventListener("keydown", keysOf(made));
    made.start = () => start(made);
    made.start();
    return () => {
      removeEventListener("popstate", go);
      document.removeEventListener("keydown", keysOf(made));
      live.driver.onSpace = null;
      live.replay = null;
      made.close();
    };
  }, []);
  return replay && html`<${Shown} at=${at} replay=${replay} />`;
}

/** Where the address says: ?at=MS, else ?day=2026-11-22, else the newest day. @param {Model} replay */
async function start(replay) {
  const query = new URLSearchParams(location.search);
  const at = Number(query.get("at") || NaN);
  if (Number.isFinite(at)) return replay.seek(at);
  const asked = query.get("day") ?? "";
  const day = Number.isFinite(startOf(asked)) ? asked : await newestDay(replay);
  const first = () => (asked ? firstOf(replay) : newestOf(replay));
  if (day) replay.openDay(day, () => replay.player.seeks || replay.seekPicture(first()));
}

/** @param {Model} replay */
async function newestDay(replay) {
  try {
    const days = await replay.archive.days(replay.dayAbort.signal);
    const found = days.find(({ robots }) => robots.includes(replay.ref));
    if (!found) replay.dayProblem = `There is no recording of ${nameIn(replay.store, replay.ref)}`;
    replay.changed();
    return found?.day ?? "";
  } catch (error) {
    replay.dayProblem = /** @type {Error} */ (error).message;
    replay.changed();
    return "";
  }
}

/** The first session of the day, else the first message. @param {Model} replay */
function firstOf({ timeline, day }) {
  if (!timeline) return startOf(day);
  if (timeline.sessions.length) return timeline.sessions[0].since;
  const index = timeline.activity.findIndex((bits) => bits !== 0);
  return index < 0 ? startOf(day) : timeline.from + index * timeline.step;
}

/** The first picture of the newest session of the day. @param {Model} replay */
function newestOf(replay) {
  const session = replay.timeline?.sessions.at(-1);
  return session ? firstPictureOf(replay.timeline, session) : firstOf(replay);
}

const STEP_MS = 10_000;
const FAR_MS = 60_000;
const TYPING = "input, select, textarea, [contenteditable], [data-arrows]";

/** @type {WeakMap<Model, (event: KeyboardEvent) => void>} */
const handlers = new WeakMap();

/** Keys that move through the recording; the space bar comes by the driver's. @param {Model} replay */
function keysOf(replay) {
  let handler = handlers.get(replay);
  if (handler) return handler;
  handler = (event) => {
    const { target } = event;
    if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
    if (target instanceof Element && target.matches(TYPING)) return;
    if (!act(replay, event.key, event.shiftKey ? FAR_MS : STEP_MS)) return;
    event.preventDefault();
  };
  handlers.set(replay, handler);
  return handler;
}

/** @param {Model} replay @param {string} key @param {number} step @returns {boolean} whether the key means something */
function act(replay, key, step) {
  if (key === "ArrowLeft") replay.step(-step);
  else if (key === "ArrowRight") replay.step(step);
  else if (key === "+" || key === "=") replay.faster(1);
  else if (key === "-") replay.faster(-1);
  else if (key === ",") replay.stepPicture(-1);
  else if (key === ".") replay.stepPicture(1);
  else if (key === "Home") replay.seek(firstOf(replay));
  else if (key === "End") replay.seek(replay.last);
  else return false;
  return true;
}

function Shown({ at, replay }) {
  const name = useName(at);
  const live = usePage();
  return html`<div class="replay">
    <h1 class="sr">Recording of ${name}</h1>
    <${Boundary} what="The time"><${Badge} at=${at} replay=${replay} /><//>
    <${Page.Provider} value=${replay.page}>
      <div class="replay-body">
        <div class="replay-bench">
          <div class="replay-main">
            <${Boundary} what="The picture"><${Picture} at=${at} replay=${replay} live=${live} /><//>
            <${Boundary} what="The timeline"><${TimelineCard} replay=${replay} /><//>
          </div>
          <div class="replay-side">
            <${Elsewhere} at=${at} replay=${replay} />
            <${Card} id="sessions" title="Sessions" icon="list"><${Sessions} replay=${replay} /><//>
            <${Card} id="sent" title=${`Was sent to ${name}`} icon="wheel"><${Sent} replay=${replay} /><//>
            <${Card} id="download" title="Download" icon="save"><${Download} replay=${replay} /><//>
          </div>
        </div>
        <${Cards} at=${at} />
      </div>
    <//>
  </div>`;
}

/** What must not be overlooked: that this is the past. */
function Badge({ at, replay }) {
  const name = useName(at);
  useModel(replay);
  useTick(100);
  const { seeks, position } = replay.player;
  const time = seeks ? timeWords(position) : "…";
  return html`<div class="replay-badge" data-test="badge">
    <${Icon} name="recordings" />
    <p><b>Recording of ${time}</b> <span>The past of ${name}: nothing here reaches the robot.</span></p>
    <${RouteLink} to=${at} className="replay-live" label=${`Live page of ${name}`}>Live page<//>
  </div>`;
}

/** As on the robot's own page, without those that send. */
function Cards({ at }) {
  const offers = new Offers(at, useValue(at, "capabilities"), useMetrics(at));
  const [view] = useState(() => new CardView(`replay ${at}`));
  useModel(view);
  const cards = CARDS.filter((card) => !card.sends && !LEFT_OUT.includes(card.id) && card.wants(offers));
  const shown = cards.filter(({ id }) => !view.hidden.has(id));
  const narrow = shown.filter(({ engineers }) => !engineers);
  const half = Math.ceil(narrow.length / 2);
  const columns = [narrow.slice(0, half), narrow.slice(half)].filter((one) => one.length);
  const draw = (card) => html`<${Card} key=${card.id} id=${card.id} title=${card.title} icon=${card.icon} view=${view}>
    <${Boundary} what=${card.title}><${Part} part=${card.part} now at=${at} offers=${offers} view=${view} /><//>
  <//>`;
  return html`<div class="cards">
      ${columns.map((column, index) => html`<div key=${index} class="column">${column.map(draw)}</div>`)}
    </div>
    ${shown.filter(({ engineers }) => engineers).map(draw)}
    ${cards.length > shown.length &&
    html`<div class="missing">
      ${cards
        .filter(({ id }) => view.hidden.has(id))
        .map(({ id, title }) => html`<button key=${id} type="button" onClick=${() => view.show(id)}>Show ${title}</button>`)}
    </div>`}`;
}

// Recordings: which day and robot, or one robot at one time, on the page that it has live.

import { extentOf, firstOf } from "../../core/replay/timeline.js";
import { Boundary, Page, html, useEffect, useMedia, useModel, usePage, useState, useTick } from "../parts/hooks.js";
import { EXTRAS, VOICE } from "../cards/cards.js";
import { exactTime } from "../parts/more-words.js";
import { driverName, inner } from "../parts/words.js";
import { Extra, Icon, Part, RouteLink, useName } from "../parts/parts.js";
import { Robot } from "../robot/robot.js";
import { Frame, SnapshotButton } from "../robot/video.js";
import { Choose, Opening, timeWords } from "./choose.js";
import { Replay as Model } from "./model.js";
import { PlayerBar } from "./player-bar.js";

export const Replay = ({ at }) => (at ? html`<${Opened} at=${at} />` : html`<${Choose} />`);

function Opened({ at }) {
  const live = usePage();
  const [replay, setReplay] = useState(/** @type {Model | null} */ (null));
  useEffect(() => {
    const model = new Model(live, at);
    setReplay(model);
    live.replay = model; // for tests, and for people who look into it
    live.driver.onSpace = () => model.toggle();
    const abort = new AbortController();
    addEventListener("popstate", () => live.route.replay === at && model.start(), { signal: abort.signal });
    document.addEventListener("keydown", (event) => press(model, event), { signal: abort.signal });
    model.start();
    return () => {
      abort.abort();
      live.driver.onSpace = null;
      live.replay = null;
      model.close();
    };
  }, []);
  return replay && html`<${Shown} at=${at} replay=${replay} />`;
}

const STEP_MS = 10_000;
const FAR_MS = 60_000;
const END_MS = 2000; // before the last message
const TYPING = "input, select, textarea, [contenteditable], [data-arrows]";

/** Keys that move through the recording; the space bar comes by the driver's. @param {Model} replay @param {KeyboardEvent} event */
function press(replay, event) {
  const { target, key, shiftKey } = event;
  if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
  if (target instanceof Element && target.matches(TYPING)) return;
  const step = shiftKey ? FAR_MS : STEP_MS;
  const { timeline, name } = replay.day;
  /** @type {Record<string, () => void>} */
  const keys = {
    ArrowLeft: () => replay.step(-step),
    ArrowRight: () => replay.step(step),
    "+": () => replay.faster(1),
    "=": () => replay.faster(1),
    "-": () => replay.faster(-1),
    Home: () => replay.seek(firstOf(replay.day)),
    End: () => timeline && replay.seek(extentOf(timeline, name).until - END_MS),
  };
  if (!keys[key]) return;
  event.preventDefault();
  keys[key]();
}

function Shown({ at, replay }) {
  const { panels, settings } = usePage();
  const narrow = useMedia("(max-width: 760px)"); // as the page's own layout
  const name = useName(at);
  useModel(replay);
  useEffect(() => {
    if (replay.isHere) settings.begin("recordings");
  }, [replay.isHere]);
  return html`<div class="replay">
    <${Boundary} what="The time"><${Badge} at=${at} replay=${replay} /><//>
    ${replay.isHere
      ? html`<${Page.Provider} value=${replay.page}
          ><${Robot}
            at=${at}
            layout=${narrow ? "portrait" : "desktop"}
            onPanel=${() => panels.toggle("settings")}
            stage=${RecordedStage}
            watches
        /><//>`
      : html`<${Opening} name=${name} problem=${replay.feed.problem} />`}
    <${Boundary} what="What plays it"><${PlayerBar} at=${at} replay=${replay} /><//>
  </div>`;
}

/** Who had control then; "" it is not known, or nobody. @param {import("../../core/store.js").Store} store @param {string} ref */
function driverThen(store, ref) {
  const metric = store.metrics(ref).find((one) => one.startsWith("control/"));
  const { by, device } = inner(store.get(ref, metric ?? "")?.value) ?? {};
  return by ? driverName({ by, device }) : "";
}

/** What must not be overlooked: that this is the past. */
function Badge({ at, replay }) {
  const name = useName(at);
  useModel(replay);
  useTick(100);
  const { seeks, position } = replay.feed;
  const by = driverThen(replay.store, at);
  return html`<div class="replay-badge" data-test="badge">
    <${Icon} name="recordings" />
    <p>
      <b>${seeks ? timeWords(position) : "…"}</b>${by && html`<em data-test="then">${by} drove</em>`}
      <span>Recording: nothing here reaches ${name}</span>
    </p>
    <${RouteLink} to=${at} className="replay-live" label=${`Live page of ${name}`}>Live page<//>
  </div>`;
}

/** When it was taken, by the robot's clock; else when it was received. @param {any} info */
const takenAt = ({ capturedMs, receivedMs }) =>
  capturedMs !== null && Math.abs(capturedMs - receivedMs) < 3_600_000 ? capturedMs : receivedMs;

/** The picture of a recording, in the place of the live one. */
function RecordedStage({ at, offers, layout }) {
  const { recording, video } = usePage();
  useModel(recording);
  useTick(200);
  const { cover } = recording;
  const short = layout === "portrait";
  const over =
    video.info && html`<span class="tag tag-age" data-test="picture-time">recorded ${exactTime(takenAt(video.info))}</span>`;
  return html`<${Frame} label="Recorded picture" alt=${`What ${useName(at)} saw`} part="Drawn" source=${at} cover=${cover} over=${over}>
    <div class="picture-bar" role="group" aria-label="Picture and sound">
      <${SnapshotButton} source=${at} short=${short} />
      <${Extra} of=${EXTRAS} part="Marks" what="Marks of scripts" source=${at} />
      ${offers.has("audio") &&
      html`<${Boundary} what="Sound"><${Part} part=${VOICE} lines=${0} at=${at} place=${short ? "short" : "bar"} /><//>`}
    </div>
  <//>`;
}

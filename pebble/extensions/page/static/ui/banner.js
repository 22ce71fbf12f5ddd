// What must not be overlooked, over the picture or a title: stops, lost connections, and what was not done.

import {
  html, useEffect, useLayoutEffect, useMetric, useModel, useOnline, usePage, useRecent, useRefs, useState, useTick, useValue,
} from "./parts/hooks.js";
import { Model } from "./parts/models.js";
import { nameIn } from "./parts/looks.js";
import { Button, Drop, HoldButton, Icon, RouteLink, Why, useName } from "./parts/parts.js";
import { clockTime, roughly } from "./parts/words.js";

const NOTICE_MS = 6000;
const NO_ANSWER_MS = 1500;
const MOST_ALSO = 3; // others that are named
const MOST_LISTED = 50;
const STOP = "web/estop";
const HINT_MS = 3000;
const SHOWN_MS = 60_000; // a finished stop

/** Whether the screen has a place of its own for them: then it is not said twice. */
const places = new (class extends Model {
  count = 0;

  add(change) {
    this.count += change;
    this.changed();
  }
})();

/** On top of a screen that has no place for them, and while the screen is not here, or has failed. */
export function Banners({ at }) {
  useModel(places);
  return places.count ? null : html`<${All} at=${at} />`;
}

/** Over the picture, or what is in its place, or a title: nothing on the page moves. */
export function Bands({ at }) {
  useLayoutEffect(() => {
    places.add(1);
    return () => places.add(-1);
  }, []);
  return html`<${All} at=${at} />`;
}

/** A stop first. */
function All({ at }) {
  const { connection } = usePage();
  useModel(connection);
  return html`<section class="banners" aria-label="What to know now">
    ${at ? html`<div class="stop-banners"><${StopBanner} at=${at} /></div>` : html`<${Unconfirmed} />`}
    <${PressBanner} />
    <div role="alert"><${ServerBanner} at=${at} />${at && html`<${SilentBanner} at=${at} />`}</div>
    ${at && html`<${AlsoStopped} at=${at} /><${SlowLink} at=${at} />`}
    <${Notice} />
    ${at && html`<${ControlHint} />`}
  </section>`;
}

const Banner = ({ kind, icon = "warning", button = null, children }) => html`<div class=${`banner ${kind}`}>
  <${Icon} name=${icon} />
  <div class="banner-text">${children}</div>
  ${button}
</div>`;

const Reload = ({ children }) => html`<${Button} onPress=${() => location.reload()}>${children}<//>`;

/** No server, no broker, an old page, or no encryption. */
function ServerBanner({ at }) {
  const { connection } = usePage();
  const broker = useValue("", "web/broker");
  const { bye, you } = connection;
  if (bye) {
    return html`<${Banner} kind="bad" button=${html`<${Reload}>Connect again<//>`}>
      <p><b>The server has ended this connection:</b> ${bye.why}</p>
    <//>`;
  }
  if (connection.state === "lost") return html`<${LostBanner} at=${at} />`;
  if (connection.isOld) {
    return html`<${Banner} kind="bad" button=${html`<${Reload}>Reload<//>`}>
      <p><b>This page is older than the server.</b> Driving is off until it is loaded again.</p>
    <//>`;
  }
  if (broker && !broker.connected) {
    return html`<${Banner} kind="bad">
      <p><b>The server cannot reach the broker:</b> ${broker.problem || "no reason is known"}</p>
    <//>`;
  }
  if (broker?.not_received) {
    return html`<${Banner} kind="warn">
      <p><b>Not all robots can be seen:</b> ${broker.not_received}</p>
    <//>`;
  }
  if (you && !you.drives) {
    return html`<${Banner} kind="warn">
      <p><b>This connection is not encrypted.</b> Driving is switched off; stopping works.</p>
    <//>`;
  }
  return null;
}

function LostBanner({ at }) {
  const { connection } = usePage();
  useTick(1000);
  const { lostAt, attempts } = connection.socket;
  return html`<${Banner} kind="bad">
    <p>
      <b>No connection to the server since ${clockTime(lostAt)}.</b>${" "}
      ${at && html`What you drove stops by itself.<br />`}
      <small aria-hidden="true">Retrying${attempts > 1 ? ` (${attempts})` : ""}…</small>
    </p>
  <//>`;
}

function SilentBanner({ at }) {
  const { connection, store } = usePage();
  useTick(1000);
  const entry = useMetric(at, "web/liveness");
  const heartbeat = useValue(at, "online");
  const name = useName(at);
  if (!connection.isOpen || entry?.value?.online !== false) return null;
  const { silent_s: silent } = entry.value;
  const ms = silent === null ? null : 1000 * silent + entry.age;
  const since = ms !== null ? store.now() - ms : Number.isFinite(heartbeat?.t) ? heartbeat.t : null;
  return html`<${Banner} kind="bad">
    <p>
      <b>${name} is ${silent === null ? "offline" : "silent"}${since ? ` since ${clockTime(since)}` : ""}.</b>
      ${ms !== null && html`<span aria-hidden="true"> Last heartbeat ${roughly(ms)} ago.</span>`}
    </p>
  <//>`;
}

/** How many are stopped, or should be, where no component is open; the list has what can be done about each. */
export function StopChip() {
  const { connection, store } = usePage();
  useModel(connection, (one) => one.isOpen);
  useTick(500);
  const refs = useRefs(STOP).filter((ref) => wants(store.get(ref, STOP))).sort();
  if (!refs.length || !connection.isOpen) return null;
  const isBad = (ref) => progressOf(store, ref)?.kind === "bad";
  const bad = refs.filter(isBad);
  const latched = refs.filter((ref) => store.get(ref, STOP).value.latched).length;
  const words = bad.length ? `${bad.length} not confirmed` : latched ? `${latched} stopped` : `${refs.length} stopping`;
  const first = [...new Set([...bad, ...refs])].slice(0, MOST_LISTED);
  const chip = html`<span class="chip stopped"><${Icon} name="stop" />${words}</span>`;
  return html`<${Drop} test="stopped" className="stops" summary=${chip}>
    <${ResetAll} />
    ${first.map((ref) => html`<${StopBanner} key=${ref} at=${ref} />`)}
    ${refs.length > first.length && html`<p class="also">${refs.length - first.length} more</p>`}
  <//>`;
}

/** After a stop of several: those that this page may reset, by one hold. */
function ResetAll() {
  const { commands, connection, store } = usePage();
  const named = (ref) => store.get(ref, "capabilities")?.value?.value?.named === true;
  const refs = store.refs().filter((ref) => store.get(ref, STOP)?.value.latched && !resetReason(connection, named(ref)));
  if (refs.length < 2) return null;
  const reset = () => refs.forEach((ref) => commands.reset(ref, store.get(ref, STOP)?.value.owners));
  return html`<div class="banner stopped">
    <div class="banner-text"><b>Look at all: is everybody clear?</b></div>
    <${HoldButton} key=${refs.join()} test="reset-all" onHeld=${reset}>Hold to reset all ${refs.length}<//>
  </div>`;
}

const unconfirmed = (store) => store.refs().filter((ref) => progressOf(store, ref)?.kind === "bad").sort();

/** Where no component is open: the first that does not confirm its stop. */
function Unconfirmed() {
  const { estop, store } = usePage();
  useTick(500);
  useRefs(STOP);
  const refs = unconfirmed(store);
  if (!refs.length) return null;
  const more = refs.length > 1 ? ` So for ${refs.length - 1} more.` : "";
  return html`<${Banner} kind="bad" icon="stop"><p role="alert">${tally(estop, store)} ${progressOf(store, refs[0]).text}${more}</p><//>`;
}

function StopBanner({ at }) {
  const { commands, connection } = usePage();
  useModel(connection);
  useTick(500);
  const entry = useMetric(at, STOP);
  const view = entry?.value;
  const name = useName(at);
  const [asked, ask] = useState(false);
  const named = useValue(at, "capabilities")?.value?.named === true;
  const latched = view?.latched === true;
  useEffect(() => {
    if (!latched) ask(false);
  }, [latched]);
  if (!wants(entry)) return null;
  const progress = stopProgress(view, name, entry.age);
  const refused = (view.owners ?? []).map((one) => one.reset_refused).find(Boolean);
  const why = resetReason(connection, named);
  const id = `reset-${at}`;
  const asks = latched && asked;
  return html`<div class=${`banner ${latched || progress?.kind === "bad" ? "stopped" : "warn"}`}>
    <${Icon} name="stop" />
    <div class="banner-text">
      <div role="alert">
        ${latched && !asks && html`<p><b>${name} is stopped</b>${!progress && html` <span>${stopWords(view)}</span>`}</p>`}
        ${progress && !asks && html`<p class="banner-more">${progress.text}</p>`}
        ${latched && refused && !asks && html`<p class="banner-more"><b>Not reset:</b> ${refusedWords(refused)}.</p>`}
      </div>
      ${asks &&
      html`<p><b>Look at ${name}: is everybody clear?</b> <span>It moves again only when somebody drives it.</span></p>`}
      ${why && latched && html`<${Why} id=${id}>${why}<//>`}
    </div>
    <div class="banner-actions">
      ${latched &&
      !asked &&
      html`<${Button} test="reset" label=${`Reset ${name}…`} why=${why} because=${id} onPress=${() => ask(true)}>Reset…<//>`}
      ${asks &&
      html`<${HoldButton} test="reset-hold" disabled=${Boolean(why)} onHeld=${() => commands.reset(at, view.owners)}
          >Hold to reset<//
        >
        <${Button} test="leave-stopped" onPress=${() => ask(false)}>Leave stopped<//>`}
      ${view.sending === "old" &&
      view.stop &&
      html`<${Button} test="end-stop" onPress=${() => commands.endStop(view.stop)}>End the stop<//>`}
    </div>
  </div>`;
}

function stopWords(view) {
  const how = view.why && view.why !== "button" ? ` (${view.why})` : "";
  return `by ${view.by || "somebody"}${view.since > 0 ? `, at ${clockTime(view.since)}` : ""}${how}`;
}

/** Whether there is anything to know of its stop. */
const wants = (entry) => Boolean(entry && (entry.value.latched === true || stopProgress(entry.value, "", entry.age)));

/** @param {any} store @param {string} ref @returns {{kind: string, text: string} | null} what became of its stop */
export function progressOf(store, ref) {
  const entry = store.get(ref, STOP);
  return entry ? stopProgress(entry.value, nameIn(store, ref), entry.age) : null;
}

/** What became of the stop that is, or was, sent. @returns {{kind: string, text: string} | null} */
function stopProgress(view, name, age) {
  const more = view.sending_text ? ` ${view.sending_text}` : "";
  switch (view.sending) {
    case "sent":
      if (age > NO_ANSWER_MS) return { kind: "bad", text: `STOP NOT CONFIRMED by ${name}, and sent again…${more}` };
      return { kind: "wait", text: `Sending STOP to ${name}…${more}` };
    case "confirmed":
      return view.sending_text && age < SHOWN_MS ? { kind: "wait", text: `${name} ${view.sending_text}` } : null;
    case "old":
      return {
        kind: "wait",
        text: `${name} is stopped, but cannot be held: ${view.sending_text}. Zeros are sent to it.`,
      };
    case "not confirmed":
      return { kind: "bad", text: `STOP NOT CONFIRMED by ${name}, and no longer sent.${more}` };
    default:
      return null;
  }
}

const REFUSED = {
  count: "another stop came after the one you saw",
  boot: "it has restarted since; look again",
  old: "the reset arrived too late; try again",
};

const refusedWords = (refused) => REFUSED[refused] ?? String(refused);

function resetReason(connection, named) {
  if (!connection.isOpen) return "No connection to the server";
  return connection.may("reset", named) ? "" : `Log in as ${named ? "safety" : "driver"} to reset`;
}

/** Others than the open one. */
function AlsoStopped({ at }) {
  const { store } = usePage();
  const stopped = useRefs(STOP).filter((ref) => ref !== at && store.get(ref, STOP)?.value?.latched === true).sort();
  if (!stopped.length) return null;
  return html`<p class="also links">
    <${Icon} name="stop" /><span>Also stopped:</span> ${stopped.slice(0, MOST_ALSO).map(
      (ref) => html`<${RouteLink} key=${ref} to=${ref}>${nameIn(store, ref)}<//>`,
    )}
    ${stopped.length > MOST_ALSO && html`<${RouteLink} to="">${stopped.length - MOST_ALSO} more<//>`}
  </p>`;
}

/** How long commands take over a thin link, as the robot reports it. */
function SlowLink({ at }) {
  const { level, rtt_ms: trip, queue_ms: queue } = useValue(at, "link") ?? {};
  const ms = trip / 2 + queue;
  const online = useOnline(at);
  return online && level && level !== "wide" && ms >= 0 &&
    html`<p class="also slow" data-test="slow-link">Slow connection: commands take ${(ms / 1000).toFixed(1)} s</p>`;
}

const stops = (store) => store.refs().map((ref) => store.get(ref, STOP)?.value).filter(Boolean);

/** How many have confirmed a stop of all that was pressed here; null: none was. */
function tally({ pressed }, store) {
  if (!pressed || pressed.ref || Date.now() - pressed.at > SHOWN_MS) return null;
  const sent = stops(store).filter(({ stop, sending }) => stop === pressed.stop && sending !== "spared");
  const confirmed = sent.filter(({ sending }) => sending === "confirmed").length;
  const all = confirmed === sent.length && !store.get("", "web/broker")?.value?.stops_omitted;
  return sent.length > 1 && html`<b data-test="tally">STOP ALL: ${all ? "all" : `${confirmed} of`} ${sent.length} confirmed.</b>`;
}

/** A stop that was pressed here and of which no robot shows anything yet. */
function PressBanner() {
  const { estop, store, connection } = usePage();
  const { pressed } = estop;
  const age = pressed ? Date.now() - pressed.at : Infinity;
  useTick(age < SHOWN_MS ? 250 : 5000);
  if (!pressed || age > SHOWN_MS) return null;
  const known = stops(store).some(({ stop, latched }) => stop === pressed.stop || (latched && age > NO_ANSWER_MS));
  if (known && connection.isOpen) {
    const words = age < 10_000 && !unconfirmed(store).length && tally(estop, store);
    return words && html`<${Banner} kind="ok" icon="stop"><p role="status">${words}</p><//>`;
  }
  const whom = pressed.ref ? nameIn(store, pressed.ref) : "all robots";
  if (age < NO_ANSWER_MS) {
    return html`<${Banner} kind="warn" icon="stop"><p role="alert">STOP of ${whom}: sending…</p><//>`;
  }
  if (!pressed.reached) {
    return html`<${Banner} kind="bad">
      <p role="alert">
        <b>STOP of ${whom} DID NOT REACH the server.</b> Go to the robot, or use another way to stop it.
      </p>
    <//>`;
  }
  if (!connection.isOpen) {
    return html`<${Banner} kind="warn" icon="stop">
      <p role="alert">STOP of ${whom} reached the server. Whether it has stopped cannot be seen from here.</p>
    <//>`;
  }
  if (age > 10_000) return null;
  return html`<${Banner} kind="bad" icon="stop">
    <p role="alert"><b>STOP of ${whom} is NOT CONFIRMED.</b> ${pressed.ref ? "" : "No robot has answered."}</p>
  <//>`;
}

function Notice() {
  const { connection } = usePage();
  const { notice } = connection;
  const shown = useRecent(notice?.at ?? -Infinity, NOTICE_MS);
  return html`<div role="status" class="pill-place">${shown && html`<p class="pill">${notice.text}</p>`}</div>`;
}

/** What a person who tries to drive without control has to do first. */
function ControlHint() {
  const { driver } = usePage();
  useModel(driver);
  const shown = useRecent(driver.hintedAt, HINT_MS) && driver.reason()?.action?.kind === "take";
  return html`<div role="status" class="pill-place">
    ${shown && html`<p class="pill" data-test="hint">Take control first<kbd>Enter</kbd></p>`}
  </div>`;
}

// Which day and which robot.

import { Archive } from "../../core/replay/archive.js";
import { holding } from "../../core/replay/timeline.js";
import { Bands } from "../banner.js";
import { ROOT } from "../../core/browser.js";
import { html, useEffect, usePage, useState } from "../parts/hooks.js";
import { Button, Icon, RouteLink, Select, Skeleton } from "../parts/parts.js";
import { recordingsOf } from "../fleet/recordings-link.js";
import { iconOf } from "../fleet/fleet.js";
import { nameIn } from "../parts/looks.js";
import { Offers } from "../parts/models.js";
import { shortTime } from "../parts/more-words.js";
import { clockTime, span } from "../parts/words.js";

const short = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short" });
const long = new Intl.DateTimeFormat("en-GB", { weekday: "long", day: "numeric", month: "long", year: "numeric" });

/** @param {number} ms epoch @returns {string} 22 Nov, 10:03:12 */
export const timeWords = (ms) => `${short.format(ms)}, ${clockTime(ms)}`;

/** A recorder's day is one of UTC: here it may be of two dates. @returns {string} Sunday 22 – Monday 23 November 2026 */
const longDay = ({ first, last }) => long.formatRange(first, last);

/** @param {number} bytes @returns {string} 12 kB, 3.4 MB, 1.2 GB */
export function sizeWords(bytes) {
  if (bytes < 1e6) return `${Math.max(1, Math.round(bytes / 1e3))} kB`;
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

/** @returns {{days: import("../../core/replay/archive.js").Day[] | null, problem: string, again: () => void}} */
function useDays() {
  const [days, setDays] = useState(null);
  const [problem, setProblem] = useState("");
  const [attempt, setAttempt] = useState(0);
  useEffect(() => {
    const abort = new AbortController();
    setProblem("");
    new Archive().days(abort.signal).then(setDays, (error) => abort.signal.aborted || setProblem(error.message));
    return () => abort.abort();
  }, [attempt]);
  return { days, problem, again: () => setAttempt(attempt + 1) };
}

/** The shape of a recording's page until it is here. @param {{name: string, problem?: string}} props */
export const Opening = ({ name, problem }) => html`<div class="robot" aria-busy="true">
  <h1 class="sr">${name}</h1>
  <div class="bench connecting">
    <div class="stage">
      <div class="picture">
        <div class="canvas"><canvas width="640" height="360" aria-hidden="true"></canvas></div>
        <p class=${problem ? "cover" : "sr"} role="status">${problem || "Loading the recording…"}</p>
      </div>
      <div class="picture-bar"></div>
    </div>
    <section class="card"><${Skeleton} lines=${5} /></section>
  </div>
</div>`;

const addressOf = (ref, day) => `${recordingsOf(ref)}?day=${day}`;

const ALL_DAYS = `${ROOT}replay?days`;

/** The newest recording, or all days, newest first, where the address asks for them or there is nothing to show. */
export function Choose() {
  const { route, store } = usePage();
  const { days, problem, again } = useDays();
  const [newest] = days ?? [];
  const shown = newest?.robots.length && !new URLSearchParams(location.search).has("days") ? newest : null;
  useEffect(() => {
    if (!shown) return;
    history.replaceState(null, "", recordingsOf(mostDriven(store, shown)));
    route.changed();
  }, [shown]);
  if (shown || (!days && !problem)) {
    return html`<div class="replay"><${Opening} name="Recordings" />
      <section class="card player"><div class="player-marks loading"><i class="bone"></i></div></section></div>`;
  }
  return html`<div class="replay-choose">
    <div class="screen-title"><h1>Recordings</h1><${Bands} at="" /></div>
    ${problem &&
    html`<p class="failed" role="alert">
      The recordings cannot be listed: ${problem} <${Button} onPress=${again}>Try again<//>
    </p>`}
    ${days &&
    !days.length &&
    html`<div class="empty">
      <${Icon} name="recordings" />
      <p><b>Nothing is recorded yet</b></p>
      <p>Run <code>pebble record</code> at this server's broker: what it writes appears here while it runs.</p>
    </div>`}
    <ul class="replay-days">
      ${(days ?? []).map((one) => html`<${Day} key=${one.day} one=${one} />`)}
    </ul>
  </div>`;
}

/** Of those with a camera, if there are any. @param {any} store @param {import("../../core/replay/archive.js").Day} day @returns {string} */
function mostDriven(store, { robots, driven = {} }) {
  const sees = (ref) => Number(new Offers(ref, store.get(ref, "capabilities")?.value).hasVideo);
  return [...robots].sort((a, b) => sees(b) - sees(a) || (driven[b] ?? 0) - (driven[a] ?? 0))[0];
}

function Day({ one }) {
  const { day, robots, bytes, first, last, gaps, unread } = one;
  const { store } = usePage();
  const facts = [`${shortTime(first)} to ${shortTime(last)}`, sizeWords(bytes), gaps ? `${gaps} ${gaps === 1 ? "gap" : "gaps"}` : ""];
  return html`<li class="replay-day" data-test=${`day-${day}`}>
    <div>
      <h2>${longDay(one)}</h2>
      <p class="dim">${facts.filter(Boolean).join(" · ")}</p>
      ${unread?.map((line) => html`<p key=${line} class="failed">Not all can be read of ${line}</p>`)}
    </div>
    <ul class="replay-robots">
      ${robots.map(
        (ref) => html`<li key=${ref}>
          <${RouteLink} path=${addressOf(ref, day)} className="button" label=${`${nameIn(store, ref)} on ${longDay(one)}`}
            ><${Icon} name=${iconOf(ref)} />${nameIn(store, ref)}<//
          >
        </li>`,
      )}
    </ul>
  </li>`;
}

/** Another robot, or another day. */
export function Elsewhere({ at, replay }) {
  const { route, store } = usePage();
  const { days } = useDays();
  const { name } = replay.day;
  const known = days ?? [];
  const robots = [...new Set([at, ...(known.find(({ day }) => day === name)?.robots ?? [])])].sort();
  const others = known.filter(({ day, robots }) => day === name || robots.includes(at));
  return html`<div class="replay-elsewhere">
    <${Select}
      test="replay-robot"
      title="Robot"
      value=${at}
      choices=${robots.map((ref) => [ref, nameIn(store, ref)])}
      onChoose=${(ref) => route.open(`${recordingsOf(ref)}?at=${Math.round(replay.feed.position)}`)}
    />
    <${Select}
      test="replay-day"
      title="Day"
      value=${name}
      choices=${others.length ? others.map((one) => [one.day, longDay(one)]) : [[name, name]]}
      onChoose=${(day) => replay.openDay(day)}
    />
    <${RouteLink} path=${ALL_DAYS} className="button" label="All days with recordings">All days<//>
  </div>`;
}

/** When it was used that day. */
export function Sessions({ replay }) {
  const { day, feed } = replay;
  if (!day.sessions.length) return html`<p class="dim">${day.timeline ? "It was not used that day." : "…"}</p>`;
  const now = holding(day.sessions, feed.position);
  return html`<ol class="sessions">
    ${day.sessions.map(
      (session) => html`<li key=${session.since}>
        <${Button} test="session" aria-current=${session === now ? "true" : undefined} onPress=${() => replay.seek(session.since)}>
          <span>${clockTime(session.since)} – ${clockTime(session.until)}</span> <small>${span(session.until - session.since)}</small>
        <//>
      </li>`,
    )}
  </ol>`;
}

// Which day and which robot.

import { Archive } from "../../core/replay/archive.js";
import { Bands } from "../banner.js";
import { ROOT } from "../../core/browser.js";
import { html, useEffect, useModel, usePage, useState } from "../parts/hooks.js";
import { Icon, RouteLink } from "../parts/parts.js";
import { recordingsOf } from "../fleet/recordings-link.js";
import { iconOf } from "../fleet/fleet.js";
import { nameIn } from "../parts/looks.js";
import { shortTime } from "../parts/more-words.js";
import { clockTime } from "../parts/words.js";

const date = new Intl.DateTimeFormat("en-GB", { weekday: "short", day: "numeric", month: "short", year: "numeric" });
const short = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short" });
const utc = new Intl.DateTimeFormat("en-GB", {
  weekday: "long",
  day: "numeric",
  month: "long",
  year: "numeric",
  timeZone: "UTC",
});

/** @param {number} ms epoch @returns {string} Sun, 22 Nov 2026 */
export const dayWords = (ms) => date.format(ms);

/** @param {number} ms epoch @returns {string} 22 Nov, 10:03:12 */
export const timeWords = (ms) => `${short.format(ms)}, ${clockTime(ms)}`;

/** @param {string} day "2026-11-22" @returns {string} Sunday 22 November 2026 */
const longDay = (day) => utc.format(Date.parse(`${day}T00:00:00Z`));

/** @param {number} bytes @returns {string} 12 kB, 3.4 MB, 1.2 GB */
export function sizeWords(bytes) {
  if (bytes < 1e6) return `${Math.max(1, Math.round(bytes / 1e3))} kB`;
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

const monthWords = new Intl.DateTimeFormat("en-GB", { month: "long", year: "numeric", timeZone: "UTC" });

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

const addressOf = (ref, day) => `${recordingsOf(ref)}?day=${day}`;

const ALL_DAYS = `${ROOT}replay?days`;

/** The newest recording, or all days, newest first, where the address asks for them or there is nothing to show. */
export function Choose() {
  const { route } = usePage();
  const { days, problem, again } = useDays();
  const [newest] = days ?? [];
  const shown = newest?.robots.length && !new URLSearchParams(location.search).has("days") ? newest : null;
  useEffect(() => {
    if (!shown) return;
    history.replaceState(null, "", recordingsOf(mostDriven(shown)));
    route.changed();
  }, [shown]);
  return html`<div class="replay-choose">
    <div class="screen-title"><h1>Recordings</h1><${Bands} at="" /></div>
    ${problem &&
    html`<p class="failed" role="alert">
      The recordings cannot be listed: ${problem} <button type="button" onClick=${again}>Try again</button>
    </p>`}
    ${(shown || (!days && !problem)) &&
    html`<div class="loading bones" role="status"><span class="sr">Looking for recordings…</span><i></i><i></i><i></i></div>`}
    ${days &&
    !days.length &&
    html`<div class="empty">
      <${Icon} name="recordings" />
      <p><b>Nothing is recorded yet</b></p>
      <p>Run <code>pebble record</code> at this server's broker: what it writes appears here while it runs.</p>
    </div>`}
    <ul class="replay-days">
      ${(shown ? [] : (days ?? [])).map((one) => html`<${Day} key=${one.day} one=${one} />`)}
    </ul>
  </div>`;
}

/** @param {import("../../core/replay/archive.js").Day} day @returns {string} */
const mostDriven = ({ robots, driven = {} }) => [...robots].sort((a, b) => (driven[b] ?? 0) - (driven[a] ?? 0))[0];

function Day({ one: { day, robots, bytes, first, last, gaps, unread } }) {
  const { store } = usePage();
  const facts = [`${shortTime(first)} to ${shortTime(last)}`, sizeWords(bytes), gaps ? `${gaps} ${gaps === 1 ? "gap" : "gaps"}` : ""];
  return html`<li class="replay-day" data-test=${`day-${day}`}>
    <div>
      <h2>${longDay(day)}</h2>
      <p class="dim">${facts.filter(Boolean).join(" · ")}</p>
      ${unread?.map((line) => html`<p key=${line} class="failed">Not all can be read of ${line}</p>`)}
    </div>
    <ul class="replay-robots">
      ${robots.map(
        (ref) => html`<li key=${ref}>
          <${RouteLink} path=${addressOf(ref, day)} className="button" label=${`${nameIn(store, ref)} on ${longDay(day)}`}
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
  useModel(replay);
  const { day } = replay;
  const known = days ?? [];
  const robots = [...new Set([at, ...(known.find((one) => one.day === day)?.robots ?? [])])].sort();
  const own = known.filter((one) => one.robots.includes(at));
  const open = (other) => {
    history.replaceState(null, "", addressOf(at, other.day));
    replay.player.pause(); // else its own day would be opened again
    const first = () => replay.timeline.sessions[0]?.since ?? other.first;
    replay.openDay(other.day, () => replay.seekPicture(first()));
  };
  return html`<div class="replay-elsewhere">
    <div class="replay-robot">
      <label class="field"
        ><span>Robot</span
        ><select
          data-test="replay-robot"
          value=${at}
          onChange=${(event) => route.open(`${recordingsOf(event.currentTarget.value)}?at=${Math.round(replay.player.position)}`)}
        >
          ${robots.map((ref) => html`<option key=${ref} value=${ref}>${nameIn(store, ref)}</option>`)}
        </select></label
      >
      <${RouteLink} path=${ALL_DAYS} className="button" label="All days with recordings">All days<//>
    </div>
    <${Calendar} key=${day.slice(0, 7)} at=${at} day=${day} days=${own} onOpen=${open} />
  </div>`;
}

const MOST_BAR = 18; // pixels

/** A month, in which the recorded days can be opened; the bar below a day is how long it was driven. */
function Calendar({ at, day, days, onOpen }) {
  const [month, turn] = useState(day.slice(0, 7));
  const months = [...new Set([...days.map((one) => one.day.slice(0, 7)), day.slice(0, 7)])].filter(Boolean).sort();
  if (!month) return null;
  const index = months.indexOf(month);
  const driven = (one) => one.driven?.[at] ?? 0;
  const inside = days.filter((one) => one.day.startsWith(month));
  const most = Math.max(60, ...inside.map(driven));
  const first = Date.parse(`${month}-01T00:00:00Z`);
  const before = (new Date(first).getUTCDay() + 6) % 7; // weeks begin on Monday
  const [year, number] = month.split("-").map(Number);
  const count = new Date(Date.UTC(year, number, 0)).getUTCDate();
  const cells = Array.from({ length: count }, (_, n) => `${month}-${String(n + 1).padStart(2, "0")}`);
  const arrow = (step, name) => html`<button
    type="button"
    class=${`quiet ${step > 0 ? "turned" : ""}`}
    aria-label=${name}
    disabled=${!months[index + step]}
    aria-describedby=${months[index + step] ? undefined : "why-month"}
    onClick=${() => turn(months[index + step])}
  >
    <${Icon} name="back" />
  </button>`;
  const cell = (name) => {
    const one = inside.find((known) => known.day === name);
    if (!one) return html`<li key=${name}><span class="dim">${Number(name.slice(8))}</span></li>`;
    const minutes = Math.round(driven(one) / 60);
    const words = driven(one) ? `, driven for ${minutes < 1 ? "less than a minute" : `${minutes} min`}` : ", not driven";
    return html`<li key=${name}>
      <button
        type="button"
        data-test=${`day-${name}`}
        aria-current=${name === day ? "date" : undefined}
        aria-label=${`${longDay(name)}${words}`}
        onClick=${() => onOpen(one)}
      >
        ${Number(name.slice(8))}<i style=${{ width: `${Math.round((MOST_BAR * driven(one)) / most)}px` }}></i>
      </button>
    </li>`;
  };
  return html`<section class="card month" aria-label="Days with recordings">
    <div class="month-head">${arrow(-1, "Earlier month")}
      <h2>${monthWords.format(first)}</h2>
      ${arrow(1, "Later month")}
    </div>
    <ul class="month-days" data-test="month">
      ${["M", "T", "W", "T", "F", "S", "S"].map((name, n) => html`<li key=${`w${n}`} class="dim" aria-hidden="true">${name}</li>`)}
      ${Array.from({ length: before }, (_, n) => html`<li key=${`b${n}`} aria-hidden="true"></li>`)} ${cells.map(cell)}
    </ul>
    <p class="dim">The bar below a day is how long it was driven.</p>
    <span class="sr" id="why-month">No other month on that side has recordings</span>
  </section>`;
}

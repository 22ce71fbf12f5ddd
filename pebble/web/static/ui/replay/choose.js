// Which day and which robot.

import { Archive } from "../../core/replay/archive.js";
import { html, useEffect, useModel, usePage, useState } from "../parts/hooks.js";
import { Icon, RouteLink, Why } from "../parts/parts.js";
import { recordingsOf } from "../fleet/recordings-link.js";
import { iconOf } from "../fleet/fleet.js";
import { shortTime } from "../parts/more-words.js";
import { clockTime, nameOf } from "../parts/words.js";

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

/** All days with recordings, newest first. */
export function Choose() {
  const { days, problem, again } = useDays();
  return html`<div class="replay-choose">
    <h1>Recordings</h1>
    ${problem &&
    html`<p class="failed" role="alert">
      The recordings cannot be listed: ${problem} <button type="button" onClick=${again}>Try again</button>
    </p>`}
    ${!days && !problem && html`<p class="dim" role="status">Looking for recordings…</p>`}
    ${days && !days.length && html`<div class="empty"><${Icon} name="recordings" /><p>Nothing is recorded yet.</p></div>`}
    <ul class="replay-days">
      ${(days ?? []).map((one) => html`<${Day} key=${one.day} one=${one} />`)}
    </ul>
  </div>`;
}

function Day({ one: { day, robots, bytes, first, last, gaps, unread } }) {
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
          <${RouteLink} path=${addressOf(ref, day)} className="button" label=${`${nameOf(ref)} on ${longDay(day)}`}
            ><${Icon} name=${iconOf(ref)} />${nameOf(ref)}<//
          >
        </li>`,
      )}
    </ul>
  </li>`;
}

/** @param {number} count of days @param {number} index of the one that is open @returns {string} */
function whyNoDay(count, index) {
  if (count < 2) return "No other day of it is recorded";
  if (index < 1) return "No earlier day of it is recorded";
  return index === count - 1 ? "No later day of it is recorded" : "";
}

/** Another robot, or another day. */
export function Elsewhere({ at, replay }) {
  const { route } = usePage();
  const { days } = useDays();
  useModel(replay);
  const { day } = replay;
  const known = days ?? [];
  const robots = [...new Set([at, ...(known.find((one) => one.day === day)?.robots ?? [])])].sort();
  const own = [...new Set([day, ...known.filter((one) => one.robots.includes(at)).map((one) => one.day)])].filter(Boolean);
  const index = own.sort().indexOf(day);
  const why = whyNoDay(own.length, index);
  const open = (other) => {
    history.replaceState(null, "", addressOf(at, other));
    replay.player.pause(); // else its own day would be opened again
    replay.openDay(other, () => replay.seek(replay.timeline.sessions[0]?.since ?? known.find((one) => one.day === other)?.first ?? NaN));
  };
  return html`<div class="replay-elsewhere">
    <label class="field"
      ><span>Robot</span
      ><select
        data-test="replay-robot"
        value=${at}
        onChange=${(event) => route.open(`${recordingsOf(event.currentTarget.value)}?at=${Math.round(replay.player.position)}`)}
      >
        ${robots.map((ref) => html`<option key=${ref} value=${ref}>${nameOf(ref)}</option>`)}
      </select></label
    >
    <div class="replay-day-choice">
      <label class="field"
        ><span>Day</span
        ><select data-test="replay-day" value=${day} onChange=${(event) => open(event.currentTarget.value)}>
          ${own.map((one) => html`<option key=${one} value=${one}>${one}</option>`)}
        </select></label
      >
      ${[-1, 1].map((step) => {
        const off = index < 0 || !own[index + step];
        return html`<button
          key=${step}
          type="button"
          class=${step > 0 ? "turned" : ""}
          aria-label=${step > 0 ? "Day after" : "Day before"}
          disabled=${off}
          aria-describedby=${off ? "why-day" : undefined}
          onClick=${() => open(own[index + step])}
        >
          <${Icon} name="back" />
        </button>`;
      })}
    </div>
    ${why && html`<${Why} id="why-day">${why}<//>`}
  </div>`;
}

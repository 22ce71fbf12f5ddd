// Who did what to this robot, as the robot itself has kept it, and what was refused.

import { ROOT } from "../../core/browser.js";
import { isObject } from "../../core/json.js";
import { html, useEffect, useState } from "../parts/hooks.js";
import { useName } from "../parts/parts.js";
import { clockTime } from "../parts/words.js";
import { Panel } from "../panels/panel.js";

const CHAINS = /** @type {const} */ ([
  ["acts", "What people did"],
  ["refused", "What was refused"],
]);
const KNOWN = ["n", "t", "h", "what", "who", "after", "count"];
/** What else a line may have, in words. */
const FACTS = {
  device: (value) => `on ${text(value)}`,
  file: (value) => text(value),
  name: (value) => text(value),
  on: (value) => (value ? "on" : "off"),
  seconds: (value) => `for ${text(value)} s`,
  commands: (value) => `${text(value)} drive commands`,
  since: (value) => `since ${timeOf(value)}`,
  why: (value) => `reason: ${text(value)}`,
};
const LONGEST = 200; // characters of one text: all of it is the robot's

/** @typedef {{lines: any[], problem: string, noted: number, failed: string, before: number}} Found */

export function Audit({ at, onClose }) {
  const name = useName(at);
  const [chain, choose] = useState("acts");
  const [before, go] = useState(0); // 0: the newest
  const found = useLines(at, chain, before);
  const first = found?.lines[0]?.n;
  return html`<${Panel} id="audit" title=${`Who did what: ${name}`} onClose=${onClose}>
    <div class="audit">
      <div class="audit-tools" role="group" aria-label="Lines">
        ${CHAINS.map(
          ([id, title]) =>
            html`<button
              type="button"
              key=${id}
              data-test=${`audit-${id}`}
              aria-pressed=${chain === id}
              onClick=${() => {
                choose(id);
                go(0);
              }}
            >
              ${title}
            </button>`,
        )}
      </div>
      <p role="status" data-test="audit-state" class=${found?.problem || found?.failed ? "bad" : "dim"}>${words(found)}</p>
      <ol>
        ${linesOf(found).map((line) => html`<${Line} key=${line.key} line=${line} />`)}
      </ol>
      ${first > 1 && html`<button type="button" data-test="audit-older" onClick=${() => go(first)}>Older</button>`}
      ${before > 0 && html`<button type="button" data-test="audit-newest" onClick=${() => go(0)}>Newest</button>`}
      <p class="dim">A name with ? was not checked. Lines with a number of times stand for that many alike.</p>
    </div>
  <//>`;
}

/** @returns {Found | null} null: they are being read */
function useLines(at, chain, before) {
  const [found, take] = useState(/** @type {Found | null} */ (null));
  useEffect(() => {
    let current = true;
    take(null);
    read(at, chain, before).then((answer) => current && take(answer));
    return () => {
      current = false;
    };
  }, [at, chain, before]);
  return found;
}

/** @returns {Promise<Found>} */
async function read(ref, chain, before) {
  const nothing = { lines: [], problem: "", noted: 0, failed: "", before };
  try {
    const query = new URLSearchParams({ ref, chain, before: String(before) });
    const answer = await fetch(`${ROOT}api/robot-audit?${query}`, { cache: "no-store" });
    return answer.ok ? { ...nothing, ...(await answer.json()) } : { ...nothing, failed: await answer.text() };
  } catch {
    return { ...nothing, failed: "no connection to the server" };
  }
}

/** @param {Found | null} found @returns {string} */
export function words(found) {
  if (!found) return "Asking the robot…";
  if (found.failed) return `✖ ${found.failed}`;
  if (found.problem) return `✖ The audit was changed: ${found.problem}`;
  if (!found.lines.length) return "No lines";
  const noted = found.noted ? `; this server had noted line ${found.noted}` : "; this server has noted none yet";
  return `✔ Nothing was changed or taken out of these lines${found.before ? "" : noted}`;
}

function Line({ line: { day, time, what, who, more } }) {
  return html`<li data-test="audit-line">
    ${day && html`<h3>${day}</h3>`}
    <p><b>${what}</b><time>${time}</time></p>
    <p>${who} <span class="dim">${more}</span></p>
  </li>`;
}

/** The newest first; each day is with its first line. @param {Found | null} found */
function linesOf(found) {
  let before = "";
  return [...(found?.lines ?? [])].reverse().map((line, index) => {
    const parts = partsOf(line);
    const day = parts.day === before ? "" : parts.day;
    before = parts.day;
    return { ...parts, day, key: `${line.n} ${index}` };
  });
}

/** @param {any} line any JSON object of a robot */
export function partsOf(line) {
  const when = new Date(1000 * line.t);
  const what = text(line.what).replaceAll("-", " ");
  const more = Object.entries(line).filter(([key]) => !KNOWN.includes(key));
  const known = (key) => (Object.hasOwn(FACTS, key) ? FACTS[key] : (value) => `${key} ${text(value)}`);
  return {
    day: Number.isNaN(when.getTime()) ? "" : when.toLocaleDateString(undefined, { dateStyle: "long" }),
    time: timeOf(line.t),
    what: what.charAt(0).toUpperCase() + what.slice(1) + (line.count > 1 ? ` × ${text(line.count)}` : ""),
    who: line.who === "?" ? "Without a name" : text(line.who),
    more: text(more.map(([key, value]) => known(key)(value)).join(", ")),
  };
}

const timeOf = (t) => (Number.isNaN(new Date(1000 * t).getTime()) ? "" : clockTime(1000 * t));

const text = (value) => {
  const whole = isObject(value) || Array.isArray(value) ? JSON.stringify(value) : String(value ?? "");
  return whole.length > LONGEST ? `${whole.slice(0, LONGEST)}…` : whole;
};

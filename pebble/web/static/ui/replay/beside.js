// Beside the recorded picture: what was sent to the robot, and the sessions of the day.

import { holding } from "../../core/replay/timeline.js";
import { html, useModel, useTick } from "../parts/hooks.js";
import { clockTime, number, span } from "../parts/words.js";

const HELD_MS = 500; // a command to drive is over after that
const SHOWN = 12; // lines
const WORDS_MS = 200;

/** The newest messages that were sent to the robot then. Nothing of it is sent again. */
export function Sent({ replay }) {
  useTick(WORDS_MS);
  const { incoming, player } = replay;
  const lines = incoming.lines.slice(-SHOWN).reverse();
  return html`<div class="sent" data-test="sent">
    <${Vector} drive=${incoming.drive} position=${player.position} />
    ${lines.length
      ? html`<ol>
          ${lines.map(
            ({ number: key, since, metric, text, count }) => html`<li key=${key}>
              <time>${clockTime(since)}</time> <b>${metric}</b>${count > 1 && html` <small>×${count}</small>`}
              <span>${text}</span>
            </li>`,
          )}
        </ol>`
      : html`<p class="dim">Nothing was sent to it since the last jump.</p>`}
  </div>`;
}

/** How it was driven. @param {{drive: {at: number, x: number, z: number} | null, position: number}} props */
function Vector({ drive, position }) {
  const held = drive !== null && position - drive.at < HELD_MS && (drive.x !== 0 || drive.z !== 0);
  const { x, z } = held ? drive : { x: 0, z: 0 };
  const words = held ? `forward ${number(z, 2)}, turn ${number(x, 2)}` : "at rest";
  return html`<div class="sent-drive">
    <svg viewBox="-50 -50 100 100" class=${held ? "held" : ""} aria-hidden="true">
      <circle r="46" />
      <path d=${`M0 0L${(34 * x).toFixed(1)} ${(-34 * z).toFixed(1)}`} />
      <circle class="dot" r="11" cx=${(34 * x).toFixed(1)} cy=${(-34 * z).toFixed(1)} />
    </svg>
    <p data-test="sent-drive">It was driven: <b>${words}</b></p>
  </div>`;
}

export function Sessions({ replay }) {
  useModel(replay);
  useTick(1000);
  const { timeline, player } = replay;
  const sessions = timeline?.sessions ?? [];
  if (!sessions.length) return html`<p class="dim">${timeline ? "It was not used that day." : "…"}</p>`;
  const now = holding(sessions, player.position);
  return html`<ol class="sessions">
    ${sessions.map(
      (one) => html`<li key=${one.since}>
        <button
          type="button"
          class="wide"
          data-test="session"
          aria-current=${one === now ? "true" : undefined}
          onClick=${() => replay.seek(one.since)}
        >
          <span>${clockTime(one.since)} – ${clockTime(one.until)}</span> <small>${span(one.until - one.since)}</small>
        </button>
      </li>`,
    )}
  </ol>`;
}

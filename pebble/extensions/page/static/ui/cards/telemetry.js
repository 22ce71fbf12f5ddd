// What the component reports of itself, in words and numbers.

import { html, useMetric, useOnline, useValue } from "../parts/hooks.js";
import { Charge, Live, isGone, useEnded } from "../parts/parts.js";
import { Board } from "./board.js";
import { LOW_PERCENT, charge, looksOf } from "../parts/looks.js";
import { charging, plain } from "../parts/more-words.js";
import { battery, inner, isObject, number, typeOf } from "../parts/words.js";

const STREAM_MS = 1000;
const LEVEL_DEG = 3;

export function Telemetry({ at }) {
  const online = useOnline(at);
  return html`<${Battery} at=${at} online=${online} />
  <dl class="values">
    <${Neighbours} at=${at} />
    <${Row} at=${at} metric="sensors/imu" name="Tilt" online=${online}>${attitude}<//>
    <${Row} at=${at} metric="sensors/imu" name="Turn rate" online=${online}>${rate}<//>
    <${Row} at=${at} metric="sensors/imu" name="Acceleration" online=${online}>${acceleration}<//>
    <${Row} at=${at} metric="touch-sensors" name="Touch" online=${online}>${touch}<//>
    <${Troubles} at=${at} online=${online} />
  </dl>
  <${Hint} at=${at} />`;
}

/** One large figure: in percent with its bar, where the cells are known. */
function Battery({ at, online }) {
  const level = useMetric(at, "charging-level");
  const status = useValue(at, "charging-status");
  const { cells } = looksOf(at, useValue(at, "capabilities"));
  const percent = !level || isGone(level, online) ? null : charge(level.value, cells);
  const more = [percent !== null && cells ? battery(level.value) : "", online ? charging(status) : ""].filter(Boolean).join(", ");
  return html`<p class="figure">${level && html`<b><${Charge} at=${at} level=${level} online=${online} /></b> `}<span class="dim">${more}</span></p>
    ${percent !== null && html`<i class=${`meter ${percent < LOW_PERCENT ? "low" : ""}`} aria-hidden="true"><i style=${{ width: `${percent}%` }}></i></i>`}`;
}

/** For the maker of a robot that does not say what it can do. */
function Hint({ at }) {
  const value = useValue(at, "capabilities")?.value;
  const board = useValue(at, "web/board");
  const isKnown = value && value.announced !== true;
  if (isKnown || typeOf(at) !== "robots") return null;
  if (board?.silent) return html`<${Board} at=${at} board=${board} />`;
  const offered = value ? "What is offered here, it lists as its subscriptions" : "So there is nothing to drive";
  return html`<p class="dim" data-test="hint">
    It publishes no capabilities. ${offered}. docs/your-robot.md tells its maker what to publish.
  </p>`;
}

/** Nothing where there are no words for a value. Until its period is known, after four values, a second is assumed. */
function Row({ at, metric, name, online, children: words }) {
  const received = useMetric(at, metric);
  const ended = Boolean(useEnded(at, metric));
  const text = received && words(received.value);
  if (!text) return null;
  return html`<div>
    <dt>${name}</dt>
    <dd><${Live} entry=${received} usual=${STREAM_MS} online=${online} ended=${ended}>${text}<//></dd>
  </div>`;
}

/** Which robots of its LAN it receives, and whose script drives it. */
function Neighbours({ at }) {
  const { receives = {}, driven_by: driver } = useValue(at, "neighbours") ?? {};
  const robots = Object.entries(receives).map(([name, is]) => (is ? name : `not ${name}`));
  return html`${robots.length > 0 && html`<div><dt>Receives</dt><dd>${robots.join(", ")}</dd></div>`}
    ${driver && html`<div><dt>Driven by</dt><dd>a script of ${plain(driver)}</dd></div>`}`;
}

const degrees = (value) => `${number(value, 1)}°`;

function attitude(payload) {
  const angles = inner(payload)?.orientation_deg;
  const level = [angles?.roll, angles?.pitch].every((one) => Math.abs(one) < LEVEL_DEG);
  return level ? "level" : `roll ${degrees(angles?.roll)}, pitch ${degrees(angles?.pitch)}`;
}

const rate = (payload) => `${number(inner(payload)?.gyro_dps?.z, 1)} °/s`;

const acceleration = (payload) => `${number(inner(payload)?.accel_norm_g, 2)} g`;

function touch(payload) {
  const value = inner(payload);
  return isObject(value) ? Object.values(value).slice(0, 8).map(plain).join(" · ") : plain(value);
}

/** What fails of camera and sound; how they run is with the services. */
function Troubles({ at, online }) {
  return Object.entries(useValue(at, "media-status") ?? {})
    .filter(([, report]) => report.last_error)
    .map(
      ([name, report]) => html`<div key=${name}>
        <dt>${name.replaceAll("_", " ")}</dt>
        <dd class="bad">${online ? "" : "was: "}✖ ${plain(report.last_error)}</dd>
      </div>`,
    );
}

// What lies over a picture that is the whole page: how fast it is, how full its battery is, and where it is.

import { Odometry } from "../cards/map.js";
import { html, useMetric, useOnline, useRef, useTick, useValue } from "../parts/hooks.js";
import { Charge, Icon } from "../parts/parts.js";
import { inner, number } from "../parts/words.js";

const AT_LEAST_MS = 400; // between two places from which a speed is found
const OLD_MS = 2000;

/** ``map``: whether there is anything to draw. @param {{at: string, offers: any, map: boolean}} props */
export function Hud({ at, offers, map }) {
  const level = useMetric(at, "charging-level");
  const online = useOnline(at);
  const speed = useSpeed(at);
  return html`<div class="hud">
      ${speed !== null && html`<span data-test="hud-speed">${number(speed, 1)} m/s</span>`}
      ${level &&
      html`<span data-test="hud-battery"
        ><${Icon} name="battery" /><${Charge} at=${at} level=${level} online=${online} /></span
      >`}
    </div>
    ${map && html`<div class="hud-map" aria-hidden="true" inert><${Odometry} at=${at} offers=${offers} /></div>`}`;
}

/** @param {string} at @returns {number | null} metres per second by its wheels; null: they say nothing */
function useSpeed(at) {
  useTick(500);
  const entry = useMetric(at, "wheel-odometry");
  useValue(at, "web/liveness");
  const known = useRef({ distance: NaN, at: 0, speed: 0 });
  const distance = inner(entry?.value)?.distance_mm;
  if (!entry || !Number.isFinite(distance) || entry.age > OLD_MS) return null;
  const { current } = known;
  const passed = entry.receivedAt - current.at;
  if (Number.isNaN(current.distance) || passed > OLD_MS) Object.assign(current, { distance, at: entry.receivedAt, speed: 0 });
  else if (passed >= AT_LEAST_MS) {
    Object.assign(current, { speed: Math.abs(distance - current.distance) / passed, distance, at: entry.receivedAt });
  }
  return current.speed;
}

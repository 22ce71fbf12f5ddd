// Switched sockets: what their station reports of each, and what was asked of it.

import { isLevel, useWish } from "../parts/asking.js";
import { html, useMetric, useOnline } from "../parts/hooks.js";
import { Button, Why } from "../parts/parts.js";
import { useReasons, whyNotEnd, whyNotMoved } from "../parts/why-not.js";

const CONFIRMED_MS = 3000;

export function Outlets({ at, offers }) {
  const page = useReasons(at);
  const why = whyNotMoved(page, at);
  const all = outletsOf(offers);
  return html`${why && html`<${Why} id="why-outlets">${why}<//>`}
    <ul class="outlets">
      ${all.map((one, index) => html`<${Outlet} key=${one.name} ...${one} at=${at} id=${index} page=${page} />`)}
    </ul>
    ${!all.length && html`<p class="dim">No outlet is connected.</p>`}`;
}

/**
 * The outlets that the capabilities list, and those that have reported; of a component without such capabilities it is
 * assumed that they can be switched.
 * @param {import("../parts/models.js").Offers} offers @returns {{name: string, controls: boolean}[]}
 */
export function outletsOf(offers) {
  const section = offers.section("outlets");
  /** @type {Map<string, boolean>} */
  const found = new Map();
  for (const { name, controls } of section.outlets ?? []) found.set(name, controls !== false);
  for (const metric of offers.metrics) {
    const name = /^outlets\/([^/]+)\/status$/.exec(metric)?.[1];
    if (name && !found.has(name)) found.set(name, section.available !== true);
  }
  return [...found].map(([name, controls]) => ({ name, controls }));
}

/**
 * Why this one cannot be switched ``on`` or off; "" where it can. Only what its report says counts against it, and only
 * against switching on.
 * @param {string} name @param {boolean} controls @param {Record<string, unknown>} report @param {boolean} on
 */
export function obstacle(name, controls, report, on) {
  if (!controls) return "this outlet cannot be switched from here: its robot lists no control";
  if (!isLevel(name)) return "its name cannot be part of a topic";
  if (!on) return "";
  if (report.bound === false) return "no device is bound to this outlet";
  if (report.reachable === false) return "outlet is unreachable";
  return "";
}

function Outlet({ at, id, name, controls, page }) {
  const payload = useMetric(at, `outlets/${name}/status`)?.value;
  const online = useOnline(at);
  const report = payload?.value ?? {};
  const { wish, waits, late, refused, ask } = useWish(report.on, CONFIRMED_MS);
  const words = report.on === true ? "on" : report.on === false ? "off" : "unknown";
  const on = !(waits && !late ? wish.on : report.on === true); // what the next press asks
  const own = obstacle(name, controls, report, on);
  const common = on ? whyNotMoved(page, at) : whyNotEnd(page);
  const press = () => ask(on, page.commands.switchOutlet(at, name, on));
  const why = [common && "why-outlets", own && `why-outlet-${id}`].filter(Boolean).join(" ");
  return html`<li class="outlet">
    <span class="outlet-name">
      <b id=${`outlet-${id}`}>${labelOf(payload, name)}</b>
      <span data-test=${`outlet-state-${name}`}>${online ? words : `was ${words}`}</span>
      ${waits &&
      html`<span class=${late ? "bad" : "late"} role="status" data-test=${`outlet-asked-${name}`}
        >asked: ${wish.on ? "on" : "off"}${late ? ", not confirmed" : ""}</span
      >`}
      ${refused && html`<span class="bad" role="status">not done: ${refused}</span>`}
      ${own && html`<${Why} id=${`why-outlet-${id}`}>${own}<//>`}
    </span>
    <${Button}
      role="switch"
      className=${`switch ${waits ? "waits" : ""}`}
      test=${`outlet-${name}`}
      aria-checked=${String(report.on === true)}
      aria-labelledby=${`outlet-${id}`}
      why=${why}
      because=${why}
      onPress=${press}
    >
      <span aria-hidden="true"></span>
    <//>
  </li>`;
}

function labelOf(payload, name) {
  const label = payload?.label?.trim();
  return label && label !== name ? `${label} (${name})` : name;
}

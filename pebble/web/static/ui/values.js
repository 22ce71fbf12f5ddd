// Everything that was received of a component, whatever its type.

import { html, useMetric, useMetrics, useTick } from "./hooks.js";
import { inner, plain, roughly } from "./words.js";

const MOST = 120;
const LONG = 90; // characters

export function Values({ at }) {
  const metrics = useMetrics(at)
    .filter((metric) => !metric.startsWith("web/"))
    .sort();
  if (!metrics.length) return html`<p class="dim">Nothing was received yet.</p>`;
  return html`<dl class="values raw">
      ${metrics.slice(0, MOST).map((metric) => html`<${ValueRow} key=${metric} at=${at} metric=${metric} />`)}
    </dl>
    ${metrics.length > MOST && html`<p class="dim">… ${metrics.length - MOST} more</p>`}`;
}

function ValueRow({ at, metric }) {
  useTick(1000);
  const entry = useMetric(at, metric);
  if (!entry) return null;
  const text = plain(inner(entry.value));
  const age = html`<small>${roughly(entry.age)} ago</small>`;
  const long = html`<details><summary>${text.slice(0, LONG / 2)}… ${age}</summary>${text}</details>`;
  return html`<div>
    <dt>${metric}</dt>
    <dd>${text.length > LONG ? long : html`${text} ${age}`}</dd>
  </div>`;
}

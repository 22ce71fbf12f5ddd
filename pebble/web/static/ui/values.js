// Everything that was received of a component, whatever its type.

import { html, useMetric, useMetrics, useTick } from "./hooks.js";
import { inner, plain, roughly } from "./words.js";

const MOST = 120;

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
  return html`<div>
    <dt>${metric}</dt>
    <dd>${plain(inner(entry.value))} <small class="dim">${roughly(entry.age)} ago</small></dd>
  </div>`;
}

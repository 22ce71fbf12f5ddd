// Everything that was received of a component, whatever its type, as it came.

import { html, useMetric, useMetrics, useOnline, useState, useTick } from "../parts/hooks.js";
import { isGone } from "../parts/parts.js";
import { plain } from "../parts/more-words.js";
import { roughly, span } from "../parts/words.js";

const SHORT = 6; // lines that are always shown

export function Values({ at }) {
  const metrics = useMetrics(at)
    .filter((metric) => !metric.startsWith("web/"))
    .sort();
  if (!metrics.length) return html`<p class="dim">Nothing was received yet.</p>`;
  return html`<${Heartbeat} at=${at} /><dl class="all-values">${metrics.map((metric) => html`<${Metric} key=${metric} at=${at} metric=${metric} />`)}</dl>`;
}

/** How its heartbeats come, where that is known: for people they say only whether it is online. */
function Heartbeat({ at }) {
  const view = useMetric(at, "web/liveness")?.value;
  if (!view?.interval_ms) return null;
  const { interval_ms: interval, latency_ms: late, average_latency_ms: average, whole_seconds: coarse } = view;
  const lateness = coarse || late === null ? "its clock does not tell how late" : `late by ${span(late)}, on average ${span(average ?? late)}`;
  return html`<p class="dim" data-test="heartbeat">Heartbeats every ${span(interval)}, ${lateness}</p>`;
}

function Metric({ at, metric }) {
  useTick(1000);
  const entry = useMetric(at, metric);
  const online = useOnline(at);
  const [open, show] = useState(false);
  if (!entry) return null;
  const gone = isGone(entry, online);
  const rate = entry.period > 0 && !gone ? `${plain(Number((1000 / entry.period).toPrecision(2)))}/s · ` : "";
  const text = JSON.stringify(entry.value, null, 2);
  const count = text.split("\n").length;
  const details = () => html`<details open=${open} onToggle=${(event) => show(event.currentTarget.open)}>
    <summary>${count} lines</summary>
    ${open && html`<pre>${text}</pre>`}
  </details>`;
  return html`<div class=${gone ? "dim" : ""} data-test=${`value-${metric}`}>
    <dt>${metric} <small>${rate}${roughly(entry.age)} ago</small></dt>
    <dd>${count > SHORT ? details() : html`<pre>${text}</pre>`}</dd>
  </div>`;
}

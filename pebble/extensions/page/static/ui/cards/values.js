// Everything that was received of a component, whatever its type: a group of lines for each metric.

import { html, useMetric, useMetrics, useOnline, useState, useTick } from "../parts/hooks.js";
import { linesOf } from "./lines.js";
import { isGone } from "../parts/parts.js";
import { plain } from "../parts/more-words.js";
import { roughly } from "../parts/words.js";

const MOST = 120;
const SHORT = 6; // lines that are always shown

export function Values({ at }) {
  const metrics = useMetrics(at)
    .filter((metric) => !metric.startsWith("web/"))
    .sort();
  if (!metrics.length) return html`<p class="dim">Nothing was received yet.</p>`;
  return html`<dl class="all-values">
      ${metrics.slice(0, MOST).map((metric) => html`<${Metric} key=${metric} at=${at} metric=${metric} />`)}
    </dl>
    ${metrics.length > MOST && html`<p class="dim">… ${metrics.length - MOST} more</p>`}`;
}

function Metric({ at, metric }) {
  useTick(1000);
  const entry = useMetric(at, metric);
  const online = useOnline(at);
  const [open, show] = useState(false);
  if (!entry) return null;
  const { lines, omitted } = linesOf(entry.value);
  const gone = isGone(entry, online);
  const rate = entry.period > 0 && !gone ? `${plain(Number((1000 / entry.period).toPrecision(2)))}/s · ` : "";
  const count = lines.length + omitted;
  const all = () => html`<ul>
    ${lines.map(
      ({ depth, key, text }, index) => html`<li key=${index} class=${`depth-${depth}`}>
        ${key && html`<span class="dim">${key}</span> `}${text}
      </li>`,
    )}
    ${omitted > 0 && html`<li class="dim">… ${omitted} more</li>`}
  </ul>`;
  const details = () => html`<details open=${open} onToggle=${(event) => show(event.currentTarget.open)}>
    <summary>${count} lines</summary>
    ${open && all()}
  </details>`;
  return html`<div class=${gone ? "dim" : ""} data-test=${`value-${metric}`}>
    <dt>${metric} <small>${rate}${roughly(entry.age)} ago</small></dt>
    <dd>${count > SHORT ? details() : all()}</dd>
  </div>`;
}

// Values over the last minutes. What draws them is fetched with this card; nothing is drawn while it is closed.

import { numbers } from "../../core/series.js";
import { USUAL, fieldsOf, limitsOf, nameOfLine, plotsOf } from "../../core/plot-choices.js";
import { html, useMetrics, useOnline, usePage, useState, useTick } from "../parts/hooks.js";
import { read, write } from "../parts/models.js";
import { Nothing } from "../parts/nothing.js";
import { Button, Gone, Select, isGone } from "../parts/parts.js";
import { Lines } from "./plot.js";
import { recorderOf } from "../parts/recorder.js";
import { plain } from "../parts/more-words.js";
import { isObject, number } from "../parts/words.js";

const WORDS_MS = 500; // between two changes of the numbers
const MOST_METRICS = 60; // in the list

export function Plots({ at }) {
  const { store } = usePage();
  const metrics = useMetrics(at);
  const [paused, pause] = useState(false);
  const [chosen, choose] = useState(() => String(read(`plots of ${at}`, "")));
  const [all, showAll] = useState(() => read("plots all", false) === true);
  const known = USUAL.filter(({ metric }) => metrics.includes(metric));
  const usual = known.filter(({ first }) => first || all);
  const more = known.length - known.filter(({ first }) => first).length;
  const whole = chosen ? plotsOf(chosen, store.get(at, chosen)?.value) : [];
  const toggle = () => {
    write("plots all", !all);
    showAll(!all);
  };
  const change = (metric) => {
    write(`plots of ${at}`, metric);
    choose(metric);
  };
  return html`<div class="plots">
    ${!known.length && !chosen && html`<${Nothing} icon="plot" what="Nothing to plot yet">Any number that is received can be drawn.<//>`}
    ${[...usual, ...whole].map((plot) => html`<${Figure} key=${plot.id} plot=${plot} at=${at} paused=${paused} />`)}
    <div class="plot-tools">
      ${(known.length > 0 || chosen) &&
      html`<${Button} test="plots-pause" icon=${paused ? "play" : "pause"} onPress=${() => pause(!paused)}>
        ${paused ? "Go on" : "Pause"}
      <//>`}
      ${more > 0 &&
      html`<${Button} test="plots-all" aria-expanded=${all} onPress=${toggle}>${all ? `Hide ${more}` : `${more} more`}<//>`}
      <${Choose} at=${at} metrics=${metrics} chosen=${chosen} onChoose=${change} />
    </div>
  </div>`;
}

function Figure({ at, plot, paused }) {
  const page = usePage();
  const limits = limitsOf(plot.metric);
  const series = recorderOf(page, at).follow("numbers", plot.metric, numbers, limits);
  useTick(paused ? 0 : WORDS_MS);
  const online = useOnline(at);
  const age = page.store.clock() - series.newestAt;
  const gone = isGone({ age, period: series.gapMs / 3 }, online);
  const newest = (field) => words(series, field, plot, page.store.get(at, plot.metric)?.value);
  const fields = fieldsOf(plot, series.newest);
  const name = `plot-${plot.id}`;
  const minutes = Math.round(limits.shownMs / 60_000);
  return html`<figure class="plot" data-test=${name} aria-label=${`${plot.title}, last ${minutes} minutes`}>
    <figcaption>
      <b>${plot.title}</b>
    </figcaption>
    <${Lines}
      key=${fields.join()}
      series=${series}
      fields=${fields}
      shownMs=${limits.shownMs}
      least=${plot.least}
      paused=${paused}
    />
    <ul class="plot-values">
      ${fields.map(
        (field, index) => html`<li key=${field}>
          <svg class=${`plot-line line-${index}`} viewBox="0 0 34 10" aria-hidden="true"><path d="M1 5h32" /></svg>
          ${nameOfLine(field, plot)}${" "}
          <b>${gone && series.newest ? html`<${Gone} age=${age}>${newest(field)}<//>` : newest(field)}</b>
        </li>`,
      )}
    </ul>
  </figure>`;
}

/** The newest number of a line. */
function words(series, field, plot, payload) {
  const value = series.newest?.[field];
  const unit = plot.unit ?? (field === "value" && isObject(payload) && typeof payload.unit === "string" ? payload.unit : "");
  const text = plot.digits === undefined ? plain(value) : number(value, plot.digits);
  return `${text} ${(unit === "v" ? "V" : unit).slice(0, 12)}`.trim().replace(" °", "°");
}

/** A list of everything that has numbers. */
function Choose({ at, metrics, chosen, onChoose }) {
  const { store } = usePage();
  useTick(2000); // payloads get more fields
  const having = metrics.filter((metric) => !metric.startsWith("web/") && numbers(store.get(at, metric)?.value));
  const listed = [...new Set([...having.sort().slice(0, MOST_METRICS), chosen])].filter(Boolean);
  if (!listed.length) return null;
  const choices = [["", "Choose…"], ...listed.map((metric) => [metric, metric])];
  return html`<${Select} test="plots-of" title="Also plot" value=${chosen} choices=${choices} onChoose=${onChoose} />`;
}

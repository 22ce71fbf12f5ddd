// Values over the last minutes. What draws them is fetched with this card; nothing is drawn while it is closed.

import { numbers } from "../../core/series.js";
import { MOST_ADDED, USUAL, choices, fieldsOf, limitsOf, nameOfLine, restored } from "../../core/plot-choices.js";
import { html, useMetrics, useOnline, usePage, useState, useTick } from "../parts/hooks.js";
import { read, write } from "../parts/models.js";
import { Nothing } from "../parts/nothing.js";
import { Gone, Icon, Why, isGone } from "../parts/parts.js";
import { Lines } from "./plot.js";
import { recorderOf } from "../parts/recorder.js";
import { plain } from "../parts/more-words.js";
import { isObject, number } from "../parts/words.js";

const WORDS_MS = 500; // between two changes of the numbers
const MOST_METRICS = 60; // in the list

export function Plots({ at }) {
  const metrics = useMetrics(at);
  const [paused, pause] = useState(false);
  const [added, setAdded] = useState(() => restored(read(`plots ${at}`, [])));
  const change = (plots) => {
    write(`plots ${at}`, plots);
    setAdded(plots);
  };
  const [all, showAll] = useState(() => read("plots all", false) === true);
  const known = USUAL.filter(({ metric }) => metrics.includes(metric));
  const usual = known.filter(({ first }) => first || all);
  const more = known.length - known.filter(({ first }) => first).length;
  const toggle = () => {
    write("plots all", !all);
    showAll(!all);
  };
  const parts = { at, paused };
  const empty = !known.length && !added.length;
  return html`<div class="plots">
    ${empty && html`<${Nothing} icon="plot" what="Nothing to plot yet">Any number that is received can be drawn.<//>`}
    ${usual.map((plot) => html`<${Figure} key=${plot.id} plot=${plot} ...${parts} />`)}
    ${added.map(
      (plot) => html`<${Figure}
        key=${plot.id}
        plot=${plot}
        ...${parts}
        onRemove=${(event) => {
          event.currentTarget.closest(".plots").querySelector("select").focus();
          change(added.filter((one) => one.id !== plot.id));
        }}
      />`,
    )}
    <div class="plot-tools">
      ${!empty &&
      html`<button type="button" data-test="plots-pause" onClick=${() => pause(!paused)}>
        <${Icon} name=${paused ? "play" : "halt"} />${paused ? "Go on" : "Pause"}
      </button>`}
      ${more > 0 &&
      html`<button type="button" data-test="plots-all" aria-expanded=${all} onClick=${toggle}>
        ${all ? `Hide ${more}` : `${more} more`}
      </button>`}
      <${Add} at=${at} metrics=${metrics} added=${added} onAdd=${(plot) => change([...added, plot])} />
    </div>
  </div>`;
}

function Figure({ at, plot, paused, onRemove }) {
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
      <b>${plot.title}</b> <small>${minutes} min</small>
      ${onRemove &&
      html`<button type="button" class="quiet" aria-label=${`Remove ${plot.title}`} onClick=${onRemove}>
        <${Icon} name="close" />
      </button>`}
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
function Add({ at, metrics, added, onAdd }) {
  const { store } = usePage();
  useTick(2000); // payloads get more fields
  const shown = new Set(added.map(({ id }) => id));
  const groups = metrics
    .filter((metric) => !metric.startsWith("web/"))
    .sort()
    .slice(0, MOST_METRICS)
    .map((metric) => ({ metric, plots: choices(metric, store.get(at, metric)?.value) }))
    .filter(({ plots }) => plots.length);
  if (!groups.length && !added.length) return null;
  const full = added.length >= MOST_ADDED ? `Not more than ${MOST_ADDED}: remove one first` : "";
  const why = full || (groups.length ? "" : "Nothing with numbers was received yet");
  const choose = ({ currentTarget }) => {
    const chosen = groups.flatMap(({ plots }) => plots).find(({ id }) => id === currentTarget.value);
    currentTarget.value = "";
    if (chosen) onAdd(chosen);
  };
  return html`<label class="field"
      ><span>Add a plot</span>
      <select
        data-test="plots-add"
        value=""
        disabled=${why !== ""}
        aria-describedby=${why ? "why-plots" : undefined}
        onChange=${choose}
      >
        <option value="">choose…</option>
        ${groups.map(
          ({ metric, plots }) => html`<optgroup key=${metric} label=${metric}>
            ${plots
              .filter(({ id }) => !shown.has(id))
              .map(({ id, fields, title }) => html`<option key=${id} value=${id}>${optionWords(fields, title)}</option>`)}
          </optgroup>`,
        )}
      </select></label
    >
    ${why && html`<${Why} id="why-plots">${why}<//>`}`;
}

const optionWords = (fields, title) =>
  fields.length > 1 ? `${title.slice(title.indexOf(" ") + 1)}: ${fields.map((one) => one.slice(one.lastIndexOf(".") + 1)).join(", ")}` : fields[0];

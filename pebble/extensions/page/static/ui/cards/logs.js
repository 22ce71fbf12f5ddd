// The log lines of a robot's services as they come, filtered.

import { LEVELS } from "../../core/logs.js";
import { html, useEffect, useModel, usePage, useRef, useValue } from "../parts/hooks.js";
import { logViewOf } from "../parts/log-view.js";
import { Button, Check, Select } from "../parts/parts.js";
import { exactTime } from "../parts/more-words.js";
import { inner, isObject } from "../parts/words.js";

const SIGNS = { DEBUG: "·", INFO: "○", WARNING: "▲", ERROR: "✖", CRITICAL: "✖" };
const END_PX = 24; // so near to the end the newest line is in sight

export function Logs({ at, view: cards }) {
  const { commands, connection, store } = usePage();
  const view = useModel(logViewOf(store, at));
  const { you } = useModel(connection, (one) => one.you);
  const card = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    connection.onLogs = (message) => view.take(message);
    commands.readLogs(at, true, view.book.origin, view.book.last);
    return () => {
      connection.onLogs = null;
      commands.readLogs(at, false);
    };
  }, [view, you]); // each connection begins anew
  useEffect(() => {
    if (cards?.wanted !== "logs") return;
    cards.wanted = "";
    card.current?.scrollIntoView({ block: "nearest" });
    card.current?.querySelector("select")?.focus({ preventScroll: true });
  }, [cards?.wanted]);
  const lines = view.book.filtered(view.filter);
  return html`<div class="logs" ref=${card}>
    <${Tools} at=${at} view=${view} />
    <${Lines} view=${view} lines=${lines} />
    <${Foot} view=${view} lines=${lines} />
  </div>`;
}

function Tools({ at, view }) {
  const { filter } = view;
  const listed = inner(useValue(at, "status"))?.services;
  const known = isObject(listed) ? Object.keys(listed) : [];
  const services = [...new Set([...known, ...view.book.services, filter.service])].filter(Boolean).sort();
  return html`<div class="log-tools">
    <${Select}
      test="log-level"
      label="Least level"
      value=${String(filter.rank)}
      choices=${LEVELS.map((level, rank) => [rank, rank ? `${level} and above` : "All levels"])}
      onChoose=${(rank) => view.choose({ rank: Number(rank) })}
    />
    <${Select}
      test="log-service"
      label="Service"
      value=${filter.service}
      choices=${[["", "All services"], ...services.map((name) => [name, name])]}
      onChoose=${(service) => view.choose({ service })}
    />
    <input
      type="search"
      data-test="log-search"
      placeholder="Search"
      aria-label="Search in log lines"
      value=${filter.search}
      onInput=${(event) => view.choose({ search: event.currentTarget.value })}
    />
    <${Button} test="log-clear" onPress=${() => view.clear()}>Clear<//>
  </div>`;
}

/** All of at most 500 are drawn, each once: the others are passed over. */
function Lines({ view, lines }) {
  const box = useRef(/** @type {HTMLElement | null} */ (null));
  const nodes = useRef(new Map());
  const old = nodes.current;
  nodes.current = new Map(lines.map((line) => [line.number, old.get(line.number) ?? draw(line)]));
  useEffect(() => {
    if (view.follows && box.current) box.current.scrollTop = box.current.scrollHeight;
  });
  const scrolled = () => {
    if (!box.current) return; // the card was left meanwhile
    const { scrollTop, scrollHeight, clientHeight } = box.current;
    view.follow(scrollHeight - scrollTop - clientHeight < END_PX);
  };
  return html`<div
    class="log-box"
    data-test="log-lines"
    role="log"
    aria-live="off"
    aria-label="Log lines"
    tabindex="0"
    data-arrows
    ref=${box}
    onScroll=${scrolled}
  >
    ${view.book.cut && html`<p class="log-gap">Older lines are not kept here</p>`}
    ${lines.length ? html`<ol>${[...nodes.current.values()]}</ol>` : html`<${Empty} view=${view} />`}
  </div>`;
}

function draw({ number, t, level, service, text, gap }) {
  if (gap) return html`<li key=${number} class="log-gap">${text}</li>`;
  const known = LEVELS.includes(level); // a robot must not choose a class
  return html`<li key=${number} class=${`log-line ${known ? level.toLowerCase() : ""}`}>
    <time title=${t === null ? "" : new Date(t).toLocaleString()}>${t === null ? "no time" : exactTime(t)}</time>
    <b class="log-level"><i aria-hidden="true">${SIGNS[level] ?? "○"}</i> ${level}</b>
    <span class="log-service">${service}</span>
    <span class="log-text">${text}</span>
  </li>`;
}

function Empty({ view }) {
  const { connection } = usePage();
  const count = view.book.lines.length;
  const none = view.cleared ? "Cleared. New lines appear here." : "No log line has arrived yet.";
  const why = connection.isOpen ? none : "No connection to the server";
  return html`<p class="dim">${count ? `None of ${count} lines matches.` : why}</p>`;
}

function Foot({ view, lines }) {
  const count = view.book.lines.length;
  return html`<div class="log-foot">
    <${Check} test="log-follow" checked=${view.follows} onChange=${(follows) => view.follow(follows)}>Follow the newest line<//>
    <span class="dim" role="status">${view.follows ? "" : "Not following: you look at older lines"}</span>
    <span class="dim log-count">${lines.length === count ? `${count}` : `${lines.length} of ${count}`} lines</span>
  </div>`;
}

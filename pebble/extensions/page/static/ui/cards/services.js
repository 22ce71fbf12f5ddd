// The services of a robot: which are well, which restart, and where their log lines are.

import { html, useOnline, usePage, useValue } from "../parts/hooks.js";
import { Button } from "../parts/parts.js";
import { logViewOf } from "../parts/log-view.js";
import { plain } from "../parts/more-words.js";
import { inner, isObject } from "../parts/words.js";

const SIGNS = { ready: "●", init: "○", restarting: "▲", failed: "✖", stopped: "■" };

export function Services({ at, view }) {
  const { services, mcu } = inner(useValue(at, "status")) ?? {};
  const online = useOnline(at);
  const media = Object.entries(useValue(at, "media-status") ?? {});
  if (!isObject(services)) return html`<p class="dim">It reports no services.</p>`;
  return html`<ul class="services-list">
    ${Object.entries(services).map(
      ([name, one]) => html`<${Service} key=${name} at=${at} view=${view} name=${name} online=${online} one=${one} />`,
    )}
    ${Object.entries(isObject(mcu) ? mcu : {}).map(
      ([name, line]) => html`<${SerialLine} key=${`mcu ${name}`} name=${name} online=${online} line=${line} />`,
    )}
    ${media.map(
      ([name, report]) => html`<li key=${`media ${name}`} class=${online ? "" : "dim"} data-test=${`media-${name}`}>
        <i aria-hidden="true">${report.running ? SIGNS.ready : SIGNS.init}</i>
        <span class="services-name">${name.replaceAll("_", " ")}</span>
        <span class="services-more">${online ? "" : "was: "}${mediaWords(report)}</span>
      </li>`,
    )}
  </ul>`;
}

function mediaWords(report) {
  if (report.last_error) return plain(report.last_error);
  return report.running ? plain(report.doing ?? "running") : "rests";
}

function Service({ at, view, name, online, one }) {
  const { store } = usePage();
  const state = plain(isObject(one) ? one.state : one);
  const bad = state === "failed" || state === "restarting";
  const entry = isObject(one) ? one : {};
  const words = restartWords(entry);
  const logs = () => {
    logViewOf(store, at).choose({ service: name, rank: 0, search: "" });
    view?.reveal("logs");
  };
  return html`<li class=${online ? (bad ? "bad" : "") : "dim"} data-test=${`service-${name}`}>
    <i aria-hidden="true">${Object.hasOwn(SIGNS, state) ? SIGNS[state] : "○"}</i>
    <span class="services-name">${name.replaceAll("_", " ")}</span>
    <span class="services-state">${online ? "" : "was "}${state}</span>
    <${Button} className="quiet" test=${`logs-of-${name}`} label=${`Logs of ${name}`} onPress=${logs}>Logs<//>
    ${words && html`<span class="services-more">${words}</span>`}
  </li>`;
}

const BOARD_SIGNS = { ready: "●", booting: "○", silent: "▲", absent: "✖" };

/** A serial line, and whether its board is heard. */
function SerialLine({ name, online, line }) {
  const { state, why, heard_ms: heard } = isObject(line) ? line : {};
  const bad = state === "absent" || state === "silent";
  const silence = heard === undefined ? "nothing received yet" : heard >= 10_000 ? "nothing received for 10 s" : "";
  const words = plain(why ?? (state === "ready" || state === "silent" ? silence : ""));
  return html`<li class=${online ? (bad ? "bad" : "") : "dim"} data-test=${`mcu-line-${name}`}>
    <i aria-hidden="true">${Object.hasOwn(BOARD_SIGNS, state) ? BOARD_SIGNS[state] : "○"}</i>
    <span class="services-name">board on ${name}</span>
    <span class="services-state">${online ? "" : "was "}${plain(state)}</span>
    ${words && html`<span class="services-more">${words}</span>`}
  </li>`;
}

/** @param {Record<string, any>} one @returns {string} */
function restartWords(one) {
  if (!(one.restarts > 0)) return "";
  const often = one.restarts_per_minute > 0 && `${plain(one.restarts_per_minute)}× within a minute`;
  return [`restarted ${plain(one.restarts)}×`, often, one.last_exit && `last exit: ${plain(one.last_exit)}`].filter(Boolean).join("; ");
}

// The header of every screen: which robot, whether it is there, and STOP.

import * as browser from "../core/browser.js";
import { StopChip } from "./banner.js";
import { Boundary, html, styled, useMetric, useModel, useOnline, usePage, usePart, useRefs, useTick, useValue } from "./parts/hooks.js";
import { nameIn } from "./parts/looks.js";
import { Button, Charge, Face, Icon, RouteLink, Select, StopButton, useItself, useName } from "./parts/parts.js";
import { driverName, kindOf, roughly, span, typeOf } from "./parts/words.js";

const LATE_MS = 300; // of the way to the server and back

export function Header({ at, layout, panel, onPanel, drawer, onDrawer }) {
  const { commands, driver, panels, route } = usePage();
  const wide = layout === "desktop";
  const name = useName(at);
  return html`<header class="top">
    <div class="where">
      ${at || route.replay !== null ? html`<${BackLink} />` : html`<${Brand} />`}
      ${at && html`<${Picker} at=${at} />`}
    </div>
    ${at && wide && html`<${Vital} at=${at} />`}
    <div class="top-space"></div>
    ${wide && html`<${ConnectionState} at=${at} />`} ${!at && html`<${StopChip} />`}
    ${wide && at && html`<${AllButton} outlined /><span class="rule"></span>`}
    ${wide &&
    at &&
    html`<${Button} className="quiet round-icon" test="open-help" label="Help" icon="help" onPress=${() => panels.toggle("help")} />`}
    <${Boundary} what="Notices"><${Notices} at=${at} wide=${wide || (layout === "portrait" && at !== "")} room=${wide} /><//>
    ${layout === "immersive" &&
    html`<${Button} className="round" test="drawer" label="Everything else" aria-expanded=${drawer} icon="menu" onPress=${onDrawer} />
      ${browser.fullScreen.on &&
      html`<${Button} className="round" label="Leave full screen" icon="small" onPress=${() => browser.fullScreen.toggle()} />`}`}
    ${(wide || !at) && html`<${Me} at=${at} panel=${panel} onPanel=${onPanel} wide=${wide} />`}
    ${at &&
    html`<${StopButton}
      test="stop-one"
      onStop=${() => commands.stop(driver.ref)}
      label=${`STOP: emergency stop of ${name}`}
      className="stop-one"
    >
      <${Icon} name="stop" />STOP
    <//>`}
    ${!at && html`<${AllButton} />`}
  </header>`;
}

/** ``outlined``: beside the filled one for the open robot. */
export function AllButton({ outlined = false }) {
  const { commands } = usePage();
  return html`<${StopButton}
    test="stop-all"
    onStop=${() => commands.stop("")}
    label="STOP ALL: emergency stop of all robots"
    className=${outlined ? "stop-all outlined" : "stop-all"}
  >
    <${Icon} name="stop" />${outlined ? "Stop all" : "STOP ALL"}
  <//>`;
}

const Brand = () => html`<span class="brand"><${Icon} name="logo" /><span>Pebble</span></span>`;

const BackLink = () => html`<${RouteLink} to="" className="back" label="Fleet: all robots"
  ><${Icon} name="back" /><span>Fleet</span><//
>`;

function Picker({ at }) {
  const { route, store } = usePage();
  const refs = [...new Set([at, ...useRefs()])].sort();
  const name = useName(at);
  return html`<label class=${`picker${name.length > 7 ? " long" : ""}`}>
    <${Face} at=${at} />
    <span class="picker-name"><b>${name}</b><${Icon} name="down" /></span>
    <span class="picker-state"><${Moved} at=${at} /><${Liveness} at=${at} /><${Volts} at=${at} /></span>
    <${Select}
      test="picker"
      label="Choose a robot"
      value=${at}
      choices=${refs.map((ref) => [ref, nameIn(store, ref) + (typeOf(ref) === "robots" ? "" : ` (${kindOf(ref)})`)])}
      onChoose=${(ref) => route.go(ref)}
    />
  </label>`;
}

/** Where there are no chips. */
function Moved({ at }) {
  const { connection } = usePage();
  const stopped = useValue(at, "web/estop")?.latched === true;
  const itself = useItself(at);
  if (stopped && connection.isOpen) return html`<b class="picker-stopped">Stopped</b>`;
  return itself && html`<b class="picker-itself">${itself}</b>`;
}

function Volts({ at }) {
  const level = useMetric(at, "charging-level");
  const online = useOnline(at);
  return level && online ? html`<span class="volts"><${Charge} at=${at} level=${level} online digits=${1} /></span>` : null;
}

/** What is shown of its heartbeats, which come all the time. */
const presence = (view) => (view?.online === false ? view.silent_s : view?.online);

/** Whether a component is there. @param {{at: string}} props */
export function Liveness({ at }) {
  const { connection } = usePage();
  useModel(connection, (one) => one.state);
  const entry = useMetric(at, "web/liveness", presence);
  const view = entry?.value;
  useTick(view?.online === false ? 1000 : 0);
  if (!connection.isOpen) {
    return html`<span class="state unknown">${connection.state === "connecting" ? "connecting…" : "not connected"}</span>`;
  }
  if (!view || view.online === null) return html`<span class="state unknown">waiting</span>`;
  if (view.online === false) {
    const silent = view.silent_s === null ? "" : ` ${roughly(1000 * view.silent_s + entry.age)}`;
    return html`<span class="state bad">${view.silent_s === null ? "offline" : `silent for${silent}`}</span>`;
  }
  return html`<span class="state ok">online</span>`;
}

function Vital({ at }) {
  const { connection, driver } = usePage();
  const { failed, doubt } = useModel(driver);
  const rests = doubt || failed.size;
  const level = useMetric(at, "charging-level");
  const charging = useValue(at, "charging-status");
  const view = useValue(at, "web/driver");
  const stopped = useValue(at, "web/estop")?.latched === true;
  const online = useOnline(at);
  const itself = useItself(at);
  return html`<div class="vital">
    ${level &&
    html`<span class="chip battery"
      ><${Icon} name=${charging?.value === true ? "charging" : "battery"} /><${Charge} at=${at} level=${level} online=${online} /></span
    >`}
    ${connection.isOpen && stopped && html`<span class="chip stopped"><${Icon} name="stop" />Stopped</span>`}
    ${itself && html`<span class="chip others" title=${itself}><${Icon} name="script" /><span>${itself}</span></span>`}
    ${connection.isOpen &&
    !stopped &&
    !itself &&
    view?.by &&
    html`<span class=${`chip ${view.you ? (rests ? "bad" : "mine") : "others"}`}><${Icon} name="wheel" /><span>${view.you ? (rests ? "Not driving" : "You drive") : `${driverName(view)} drives`}</span></span>`}
  </div>`;
}

function ConnectionState({ at }) {
  const { connection } = usePage();
  useModel(connection);
  const { socket, state } = connection;
  if (state === "connecting") return !at && html`<span class="chip plain">connecting…</span>`;
  if (state === "lost") return html`<span class="chip plain bad">not connected</span>`;
  return socket.roundTripMs > LATE_MS ? html`<span class="chip plain late">slow: ${span(socket.roundTripMs)}</span>` : null;
}

const BELL = styled(async (again) => (await import("./fleet/notices.js" + again)).Bell, "notices.css", "panels.css");

/** Fetched later. Where there is little room only their number is shown, with the settings. */
function Notices(props) {
  const { body } = usePart(BELL);
  return body ? html`<${body} ...${props} />` : props.wide && html`<span class="bell-place"></span>`;
}

function Me({ at, panel, onPanel, wide }) {
  const { connection } = usePage();
  useModel(connection);
  const { you } = connection;
  const user = you?.login ? `${you.user} (${you.role})` : "Settings";
  const text = connection.unread && !wide ? `${user}, ${connection.unread} new notices` : user;
  return html`<${Button}
    className="quiet me"
    test="settings"
    label=${text}
    aria-expanded=${panel}
    icon=${you?.login ? "person" : "settings"}
    onPress=${onPanel}
  >
    ${wide && !at && you?.login && html`<span>${you.user}</span>`}
    ${!wide && connection.unread > 0 && html`<b class="unread" aria-hidden="true">${connection.unread}</b>`}
  <//>`;
}

// Driving: who may, why not, the stick, and how fast.

import { ROOT } from "../../core/browser.js";
import { DRIVE, KEYS } from "../cards/cards.js";
import { html, useCalm, useModel, usePage, useValue } from "../parts/hooks.js";
import { Card, HoldButton, Icon, Part, Slider, set } from "../parts/parts.js";
import { Stick } from "./stick.js";
import { driverName, nameOf } from "../parts/words.js";

export function DriveCard({ at }) {
  return html`<${Card} id="drive" title="Drive" icon="wheel" className="drive">
    <${WhyLine} at=${at} />
    <${DrivePad} />
    <${Hints} />
    <${Speed} />
    <${Part} part=${DRIVE} />
  <//>`;
}

function Hints() {
  const { hints } = useModel(usePage().settings);
  return hints ? html`<div style=${{ minHeight: "88px" }}><${Part} part=${KEYS} /></div>` : null;
}

/** Why it cannot be driven now, and what can be done about it; or that it can. */
export function WhyLine({ at }) {
  const { connection, driver } = usePage();
  useModel(driver);
  const view = useValue(at, "web/driver");
  const mine = useModel(connection).isOpen && view?.you;
  const reason = driver.reason() ?? driver.doubt;
  const connected = useValue("", "web/broker")?.connected !== false; // else the banner says why
  const why = reason?.code === "broker" && !connected ? "The server cannot reach the broker" : reason?.text;
  const keys = driver.typing ? " Keys go to the field you have chosen: click beside it." : "";
  const text = why ?? (mine ? `You are driving ${nameOf(at)}.${keys}` : "");
  return html`<div class=${`why-line ${reason ? "off" : "on"}`}>
    <p id="why-drive" data-test="why"><i aria-hidden="true">${reason ? "○" : "●"}</i><span>${text}</span></p>
    <span class="sr" role="status">${useCalm(text)}</span>
    ${[driver.doubt, ...(driver.pads?.reasons() ?? "")].filter((one) => one && one !== reason).slice(0, 2).map(({ code, text }) => html`<p key=${text} class="why" data-test=${code}>${text}.</p>`)}
    <div class="why-actions">
      <${ReasonAction} action=${reason?.action} />
      ${mine && html`<button type="button" data-test="release" onClick=${() => driver.release()}>Release</button>`}
    </div>
    ${reason?.code === "lease" && view?.by && html`<p class="sr">${driverName(view)} has control.</p>`}
  </div>`;
}

function ReasonAction({ action }) {
  const { commands, driver } = usePage();
  switch (action?.kind) {
    case "take":
      return html`<button type="button" class="primary" data-test="take" onClick=${() => commands.take(false)}>
        ${action.label}
      </button>`;
    case "take-over":
      return html`<${HoldButton} test="take-over" onHeld=${() => commands.take(true)}
        >${action.label} <small>(hold 1 s)</small><//
      >`;
    case "see":
      return html`<button type="button" data-test="see" onClick=${() => see(driver)}>${action.label}</button>`;
    case "stop-script":
      return html`<button type="button" data-test="stop-script" onClick=${() => commands.stopScript(driver.ref)}>
        ${action.label}
      </button>`;
    case "login":
      return html`<a class="button" href=${`${ROOT}login`}>${action.label}</a>`;
    case "reload":
      return html`<button type="button" onClick=${() => location.reload()}>${action.label}</button>`;
    default:
      return null;
  }
}

function see(driver) {
  driver.inSight = true;
  driver.changed();
}

/** The stick with what it asks for, in words. */
export function DrivePad() {
  const { driver } = usePage();
  useModel(driver);
  const { x, z } = driver.output;
  const percent = (value) => `${Math.round(100 * Math.abs(value))} %`;
  const forward = z === 0 ? "" : `${z > 0 ? "forward" : "back"} ${percent(z)}`;
  const turn = x === 0 ? "" : `${x > 0 ? "right" : "left"} ${percent(x)}`;
  const words = [forward, turn].filter(Boolean).join(" · ");
  return html`<div class="pad">
    <${Stick} driver=${driver} />
    <p class="pad-words">${words || ((driver.reason() ?? driver.doubt) ? "" : "drag the stick")}</p>
  </div>`;
}

export function Speed() {
  const { driver } = usePage();
  const { speed } = useModel(driver).sliders;
  const text = `${Math.round(100 * speed)} %`;
  return html`<${Slider} name="Speed" value=${speed} min=${5} text=${text} onInput=${set(driver, "speed")} />`;
}

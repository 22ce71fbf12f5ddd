// Driving: who may, why not, the stick, and how fast.

import { ROOT } from "../../core/browser.js";
import { STOP_SCRIPT, scriptName } from "../../core/reasons.js";
import { DRIVE, KEYS } from "../cards/cards.js";
import { html, useCalm, useModel, usePage, useRecent, useValue } from "../parts/hooks.js";
import { Button, Card, HoldButton, Part, Slider, set, useItself, useName } from "../parts/parts.js";
import { Stick } from "./stick.js";
import { driverName } from "../parts/words.js";

const FLASH_MS = 3000;
const LONG = 9; // letters of a name on a button

export function DriveCard({ at }) {
  return html`<${Card} id="drive" title="Drive" icon="wheel" className="drive" place=${{ "data-at": "side" }}>
    <${Slot} at=${at} />
    <${DrivePad} />
    <${Hints} />
    <${Speed} />
    <div class="drive-settings"><${Part} part=${DRIVE} lines=${2} /></div>
  <//>`;
}

function Hints() {
  const { hints } = useModel(usePage().settings);
  return hints ? html`<div class="key-place"><${Part} part=${KEYS} lines=${2} /></div>` : null;
}

/**
 * Who drives, or why it cannot be driven, and what can be done about it. Its text and its buttons change, its size does
 * not.
 */
export function Slot({ at }) {
  const { connection, driver } = usePage();
  useModel(driver);
  const view = useValue(at, "web/driver");
  const mine = useModel(connection).isOpen && view?.you;
  const reason = driver.reason() ?? driver.doubt;
  const connected = useValue("", "web/broker")?.connected !== false; // else the band says why
  const name = useName(at);
  const script = useValue(at, "autonomy-status");
  const why = reason?.code === "broker" && !connected ? "The server cannot reach the broker" : reason?.text;
  const asks = mine ? driver.lease.asks : "";
  const person = asks.slice(asks.lastIndexOf("/") + 1); // without the account of the server
  const also = view?.others && view.by ? "Someone else drives, too" : "";
  const itself = useItself(at);
  const state = why ?? (mine && !itself ? `You are driving ${name}` : "");
  const text = [itself, state, asks && `${asks} asks to drive`, also].filter(Boolean).join(". ");
  const words = itself ? [itself, why ?? "Drive, and it waits."] : slotWords(reason, why ?? "", view, driver.typing, script);
  const [title, detail] = asks ? [`${asks} asks to drive`, "Rest for 5 s, and it is theirs."] : [words[0], also || words[1]];
  const [more] = [driver.doubt, ...(driver.pads?.reasons() ?? [])].filter((one) => one && one !== reason);
  const kind = itself ? "off" : !reason ? "on" : reason.code === "stopped" ? "stopped" : "off";
  return html`<div class=${`slot why-line ${kind}`}>
    <div class="slot-words" id="why-drive" data-test="why" title=${text}>
      <i class="dot" aria-hidden="true"></i>
      <p><b>${title}</b>${more ? html`<small data-test=${more.code}>${more.text}.</small>` : html`<small>${detail}</small>`}</p>
    </div>
    <span class="sr" role="status">${useCalm(text)}</span>
    <div class="why-actions">
      ${reason?.code === "connecting" && html`<button type="button" disabled aria-describedby="why-drive">Connecting…</button>`}
      <${ReasonAction} action=${reason?.action} />
      ${reason?.also && html`<${ReasonAction} action=${reason.also} />`}
      ${mine && !reason && itself && html`<${ReasonAction} action=${STOP_SCRIPT} />`}
      ${asks
        ? html`<${Button} className="primary" test="let" title=${`Let ${asks} drive`} onPress=${() => driver.release()}>
              Let ${person.length > LONG ? "them" : person} drive
            <//>
            <${Button} test="keep" onPress=${() => driver.keep()}>Keep<//>`
        : mine && html`<${Button} test="release" onPress=${() => driver.release()}>Release<//>`}
    </div>
    ${reason?.code === "lease" && view?.by && html`<p class="sr">${driverName(view)} has control.</p>`}
  </div>`;
}

/** @returns {[string, string]} what counts, and one line more */
function slotWords(reason, text, view, typing, script) {
  switch (reason?.code) {
    case undefined:
      if (typing) return ["You drive", "Keys go to the field you have chosen: click beside it."];
      if (script?.overridden) return ["You drive", `${scriptName(script)} goes on 2 s after you let go.`];
      return ["You drive", view?.keeps === false ? "It keeps no control: others may, too." : "Let go, and it stops."];
    case "connecting":
      return ["One moment", "Who drives is not known yet."];
    case "free":
      if (view?.others) return ["Nobody has control", "Someone drives all the same"];
      if (view?.keeps === false) return ["Nobody drives from here", "It keeps no control: others may drive it"];
      return ["Nobody drives", "One person at a time"];
    case "stopped":
      return ["Stopped", "Reset it at the picture to drive."];
    case "lease":
      return [`${view?.by ?? "Somebody"} drives`, origin(view)];
    case "asked":
      return [`${view?.by} is asked`, origin(view)];
    case "server":
      return ["Not connected", "What you drove stops by itself."];
    default:
      return [text, ""];
  }
}

/** By which device, and whether the name may be trusted. */
const origin = (view) => [view?.device, view?.keeps && `name ${view.checked ? "" : "not "}checked`].filter(Boolean).join(", ");

function ReasonAction({ action }) {
  const { commands, driver } = usePage();
  const { hintedAt } = driver;
  const hinted = useRecent(hintedAt, FLASH_MS);
  switch (action?.kind) {
    case "take":
      return html`<${Button}
        key=${hinted ? hintedAt : "take"}
        className=${`primary ${hinted ? "flash" : ""}`}
        test="take"
        onPress=${() => commands.take(false)}
      >
        ${action.label}<kbd>Enter</kbd>
      <//>`;
    case "ask":
      return html`<${Button} test="ask" onPress=${() => commands.take(false)}>${action.label}<//>`;
    case "give-up":
      return html`<${Button} test="give-up" onPress=${() => driver.release()}>${action.label}<//>`;
    case "take-over":
      return html`<${HoldButton} test="take-over" onHeld=${() => commands.take(true)}>${action.label}<//>`;
    case "see":
      return html`<${Button} test="see" onPress=${() => see(driver)}>${action.label}<//>`;
    case "stop-script":
      return html`<${Button} test="stop-script" onPress=${() => commands.stopScript(driver.ref)}>${action.label}<//>`;
    case "login":
      return html`<a class="button" href=${`${ROOT}login`}>${action.label}</a>`;
    case "reload":
      return html`<${Button} onPress=${() => location.reload()}>${action.label}<//>`;
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

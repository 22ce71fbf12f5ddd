// Which keys drive, how the inputs are scaled, and the extra axis of a robot that has one.

import { DOWN, UP, padName } from "../../core/inputs.js";
import { html, useEffect, useModel, usePage } from "../parts/hooks.js";
import { useExtraAxis, useKeyNames } from "../parts/keyboard.js";
import { Button, Icon, Slider, held, set } from "../parts/parts.js";

const GRID = ["KeyQ", "KeyW", "KeyE", "KeyA", "KeyS", "KeyD"];

/** They light up while they are held. */
export function KeyHints() {
  const { driver, panels } = usePage();
  useModel(driver);
  const name = useKeyNames();
  const extra = useExtraAxis();
  const has = (code) => extra || ![...UP, ...DOWN].includes(code);
  return html`<div class="keys">
    <div class="key-grid" aria-hidden="true">
      ${GRID.map((code) =>
        has(code)
          ? html`<kbd key=${code} class=${driver.inputs.keys.has(code) ? "on" : ""}>${name(code)}</kbd>`
          : html`<i key=${code}></i>`,
      )}
    </div>
    <p aria-hidden="true">or arrows drive,<br /><b>Space</b> halts,<br /><b>Esc Esc</b> is STOP</p>
    <${Button} className="quiet" test="help" label="Help" icon="help" onPress=${() => panels.show("help")} />
  </div>`;
}

/** ``open``: there is room for all of it. @param {{open?: boolean}} props */
export function DriveSettings({ open = false }) {
  const { driver } = usePage();
  const pad = driver.pads?.pad;
  const { turn, balance } = useModel(driver).sliders;
  const extra = useExtraAxis();
  const part = `${Math.round(100 * turn)} %`;
  const side = balance === 0 ? "centred" : `${Math.round(100 * Math.abs(balance))} % ${balance > 0 ? "right" : "left"}`;
  const rest = html`<${Slider} name="Balance" value=${balance} min=${-50} max=${50} text=${side} onInput=${set(driver, "balance")} />
    ${extra &&
    html`<div class="aux">
      <span>Extra axis <kbd>Q</kbd> <kbd>E</kbd></span>
      <${AuxButton} driver=${driver} value=${1} label="Extra axis up">+<//>
      <${AuxButton} driver=${driver} value=${-1} label="Extra axis down">−<//>
    </div>`}`;
  return html`<div class="sliders">
    <${Slider} name="Turn" value=${turn} min=${5} text=${part} onInput=${set(driver, "turn")} />
    ${open
      ? rest
      : html`<details class="folded">
          <summary data-test="fold-drive">Balance${extra && ", extra axis"}</summary>
          ${rest}
        </details>`}
    ${pad && html`<p class="pad-name"><${Icon} name="pad" />${padName(pad)}</p>`}
  </div>`;
}

function AuxButton({ driver, value, label, children }) {
  const reason = driver.reason();
  const end = () => driver.hold(`aux ${value}`, 0);
  useEffect(() => end, []);
  return html`<${Button}
    test=${`aux${value > 0 ? "+" : "-"}`}
    label=${label}
    why=${reason && !driver.gestureActive ? reason.text : ""}
    because="why-drive"
    ...${held((event) => driver.hold(`aux ${value}`, value, event.timeStamp), end)}
  >
    ${children}
  <//>`;
}

// Everything that keys, gamepad and fingers do here, and how stopping works.

import { ACTIONS, buttonName, buttonOf } from "../../core/actions.js";
import { USUAL, mappingOf } from "../../core/inputs.js";
import { html, useModel, usePage } from "../parts/hooks.js";
import { useExtraAxis, useKeyNames } from "../parts/keyboard.js";
import { Panel } from "./panel.js";
import { Icon } from "../parts/parts.js";

export function HelpPanel({ onClose }) {
  return html`<${Panel} id="help" onClose=${onClose} title="Keys, gamepad, and how stopping works" className="wide-panel">
    <section class="panel-text">
      <h3>How stopping works</h3>
      <ul class="plain-list">
        <li><b>Let go,</b> and it stops. So it does when this window loses the focus, and when the connection is lost.</li>
        <li><b>Space</b> stops it for now: the next command moves it again. Everybody may.</li>
        <li>
          <b>STOP</b> holds it: nothing moves it before somebody who may drive resets it, by holding the button for a
          second. Everybody may press it, also without having control. Its keys count for every robot where no single one
          is shown. Where you type Chinese, Japanese or Korean, and on macOS, Ctrl+Space may switch the input method: use
          Ctrl+Enter.
        </li>
      </ul>
      <p class="warn-box">
        <b>This is no safety-rated stop.</b> It is software over a network. Where people can be hurt, cut the power of
        the motors.
      </p>
    </section>
    <${Bindings} />
  <//>`;
}

function Bindings() {
  const { driver } = usePage();
  useModel(driver);
  const name = useKeyNames();
  const extra = useExtraAxis();
  const pad = driver.pads?.pad;
  const mapping = pad ? mappingOf(pad) : USUAL;
  const standard = pad?.mapping === "standard";
  return html`<section class="panel-text" aria-label="Keys, gamepad and touch">
    <ul class="bindings">
      ${ACTIONS.filter(({ id }) => extra || id !== "auxiliary").map(
        (action) => html`<li key=${action.id}>
          <b>${action.words}</b>
          <span>${keyWords(action, name)}</span>
          ${padWords(action, mapping, standard) &&
          html`<span class="pad-way"><${Icon} name="pad" /><span class="sr">Gamepad: </span>${padWords(action, mapping, standard)}</span>`}
          ${action.touch &&
          html`<span class="touch-way"><${Icon} name="phone" /><span class="sr">Touch: </span>${action.touch}</span>`}
        </li>`,
      )}
    </ul>
    <p class="dim">
      Keys count where they lie: other keyboards have other letters there. They do nothing while you type in a field.
      Buttons are those of ${pad ? pad.id : "a usual gamepad: connect one, click this page and press a button of it; browsers show it only then"}.
    </p>
  </section>`;
}

/** @param {import("../../core/actions.js").Action} action @param {(code: string) => string} name */
function keyWords({ keys = [], signs = [], keyWords: words }, name) {
  if (words) return words;
  const shown = [...keys.map(name), ...signs.slice(0, 1)];
  return shown.map((one) => html`<kbd key=${one}>${one}</kbd> `);
}

/** @param {import("../../core/actions.js").Action} action */
function padWords(action, mapping, standard) {
  const button = buttonOf(action, mapping);
  const { pad = "" } = action;
  if (action.button === undefined) return pad;
  return button < 0 ? "" : `${buttonName(button, standard)}${pad && `: ${pad}`}`;
}

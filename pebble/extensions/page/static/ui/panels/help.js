// Everything that keys, gamepad and fingers do here, and how stopping works.

import { ACTIONS, buttonName, buttonOf } from "../../core/actions.js";
import { USUAL, mappingOf, padName } from "../../core/inputs.js";
import { html, useModel, usePage } from "../parts/hooks.js";
import { useExtraAxis, useKeyNames } from "../parts/keyboard.js";
import { Panel } from "./panel.js";

/** Keys first: the rest opens. */
export function HelpPanel({ onClose }) {
  const { driver } = usePage();
  useModel(driver);
  const name = useKeyNames();
  const extra = useExtraAxis();
  const pad = driver.pads?.pad;
  const mapping = pad ? mappingOf(pad) : USUAL;
  const standard = pad?.mapping === "standard";
  const shown = ACTIONS.filter(({ id }) => extra || id !== "auxiliary");
  return html`<${Panel} id="help" onClose=${onClose} title="Help" className="wide-panel">
    <section class="panel-text" aria-label="Keys">
      <ul class="bindings">
        ${shown.map((action) => html`<li key=${action.id}><b>${action.words}</b><span>${keyWords(action, name)}</span></li>`)}
      </ul>
      <p class="warn-box"><b>No safety-rated stop.</b> Where people can be hurt, cut the power of the motors.</p>
      <details class="folded">
        <summary data-test="help-ways">Gamepad and touch</summary>
        <ul class="bindings">
          ${shown.map((action) => html`<li key=${action.id}><b>${action.words}</b><span>${padWords(action, mapping, standard)}</span><span>${action.touch}</span></li>`)}
        </ul>
        <p class="dim">Buttons are those of ${pad ? padName(pad) : "a usual gamepad: press one of its buttons on this page, browsers show it only then"}.</p>
      </details>
      <details class="folded">
        <summary data-test="help-stopping">How stopping works</summary>
        <ul class="plain-list">
          <li><b>Let go,</b> and it stops: also when this window loses the focus, or the connection is lost.</li>
          <li><b>Space</b> stops it for now: the next command moves it again. Everybody may.</li>
          <li>
            <b>STOP</b> holds it until somebody who may drive resets it. Everybody may press it, also without control; its
            keys count for every robot where no single one is shown. Where Ctrl+Space switches the input method, use Ctrl+Enter.
          </li>
          <li>Keys count where they lie, whatever letters they have, and do nothing while you type in a field.</li>
        </ul>
      </details>
    </section>
  <//>`;
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

// Which keys drive; they light up while they are held.

import { DOWN, UP } from "../../core/inputs.js";
import { useExtraAxis } from "../parts/axes.js";
import { html, useModel, usePage } from "../parts/hooks.js";
import { useKeyNames } from "../parts/keyboard.js";
import { Button } from "../parts/parts.js";

const GRID = ["KeyQ", "KeyW", "KeyE", "KeyA", "KeyS", "KeyD"];

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
    <${Button} className="quiet" test="help" label="All keys, and how stopping works" icon="help" onPress=${() => panels.show("help")} />
  </div>`;
}

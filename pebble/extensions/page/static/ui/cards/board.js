// A board that does not say what it can do, as two of the original: whether pages drive it.

import { useAnswer } from "../parts/asking.js";
import { html, useState } from "../parts/hooks.js";
import { Button, Check, Why, useName } from "../parts/parts.js";
import { useReasons, whyNotEnd } from "../parts/why-not.js";

/** @param {{at: string, board: import("../../messages.js").BoardView}} props */
export function Board({ at, board }) {
  const page = useReasons(at);
  const name = useName(at);
  const [asked, set] = useState(/** @type {number | undefined} */ (undefined));
  const [extra, setExtra] = useState(false);
  const answer = useAnswer(asked);
  const why = board.refused || whyNotEnd(page, "system");
  const ask = (what) => set(page.commands.askBoard(at, what, extra));
  return html`<div data-test="board">
    <p>${name} does not say what it can do. ${board.by ? `${board.by} lets pages drive it.` : "Allow driving?"} ${board.risk}</p>
    ${board.by
      ? html`<${Button} test="board-withdraw" why=${why} because="board-why" onPress=${() => ask("withdraw")}>No longer<//>`
      : html`<${Check} test="board-extra" checked=${extra} why=${why} onChange=${setExtra}>It has an extra axis (grousers)<//>
          <${Button} test="board-allow" why=${why} because="board-why" onPress=${() => ask("allow")}>Allow driving<//>`}
    ${why && html`<${Why} id="board-why">${why}<//>`}
    ${board.parked && html`<p role="status">${board.parked}</p>`}
    ${board.parked &&
    html`<${Button} test="board-clear" why=${whyNotEnd(page)} because="board-clear-why" onPress=${() => ask("clear")}>Clear it<//>`}
    ${answer.op === "refused" && html`<p role="status">Not done: ${answer.why}</p>`}
  </div>`;
}

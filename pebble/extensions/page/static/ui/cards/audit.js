// Who did what to this robot from pages of this server: the newest rows of its audit.

import { ROOT } from "../../core/browser.js";
import { html, useEffect, useState } from "../parts/hooks.js";
import { useName } from "../parts/parts.js";
import { clockTime } from "../parts/words.js";
import { Panel } from "../panels/panel.js";

export function Audit({ at, onClose }) {
  const name = useName(at);
  const [rows, take] = useState(/** @type {any[] | null} */ (null)); // null: they are being read
  const [failed, fail] = useState("");
  useEffect(() => {
    read(at).then(take, (error) => fail(error.message));
  }, [at]);
  const state = failed ? `✖ ${failed}` : rows ? `The newest ${rows.length} rows of this server` : "Reading…";
  return html`<${Panel} id="audit" title=${`Who did what: ${name}`} onClose=${onClose}>
    <div class="audit">
      <p role="status" data-test="audit-state" class=${failed ? "bad" : "dim"}>${state}</p>
      <table>
        <tbody>
          ${[...(rows ?? [])].reverse().map((row, index) => html`<${Row} key=${`${row.at} ${index}`} row=${row} />`)}
        </tbody>
      </table>
      <p class="dim">What did not come from here, the robot has logged: on it, pebble fleet audit prints that.</p>
    </div>
  <//>`;
}

async function read(ref) {
  const answer = await fetch(`${ROOT}api/audit?${new URLSearchParams({ ref })}`, { cache: "no-store" });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

function Row({ row: { at, what, ref, user, device, address, detail, count } }) {
  const words = [what + (ref === "all" ? " all" : ""), count > 1 ? `× ${count}` : ""].join(" ");
  const day = new Date(1000 * at).toLocaleDateString(undefined, { month: "short", day: "numeric" });
  return html`<tr data-test="audit-line">
    <td>${day}<br />${clockTime(1000 * at)}</td>
    <td><b>${words}</b><br /><span class="dim">${detail}</span></td>
    <td>${user}<br /><span class="dim">${[device, address].filter(Boolean).join(", ")}</span></td>
  </tr>`;
}

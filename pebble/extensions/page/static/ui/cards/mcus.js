// A section for each self-describing microcontroller: what it measures, and what it takes as commands.

import { isLevel, useAnswer } from "../parts/asking.js";
import { html, useMetric, useOnline, usePage, useState, useTick, useValue } from "../parts/hooks.js";
import { command, fieldOf, range, step, unsendable } from "./manifest.js";
import { Button, Check, Why, isGone } from "../parts/parts.js";
import { refuses } from "../parts/typed.js";
import { useReasons, whyNotMoved } from "../parts/why-not.js";
import { plain } from "../parts/more-words.js";
import { clockTime, roughly } from "../parts/words.js";

export function Mcus({ at, offers }) {
  const why = whyNotMoved(useReasons(at), at);
  const uids = offers.metrics
    .map((metric) => /^mcu\/([^/]+)\/describe$/.exec(metric)?.[1])
    .filter(Boolean)
    .sort();
  return uids.map((uid, index) => html`<${Mcu} key=${uid} at=${at} uid=${uid} id=${`mcu-${index}`} whyNot=${why} />`);
}

function Mcu({ at, uid, id, whyNot }) {
  const { model, firmware_version: firmware, interfaces } = useValue(at, `mcu/${uid}/describe`) ?? { interfaces: [] };
  return html`<section class="mcu" aria-labelledby=${id} data-test=${`mcu-${uid}`}>
    <h3 id=${id}>${uid}</h3>
    <p class="dim">${model || "unknown model"} · firmware ${firmware || "unknown"}</p>
    ${interfaces.map((one, index) => {
      const key = `${one.dir} ${one.name} ${index}`; // a new manifest must not inherit what was entered
      if (one.dir === "out") return html`<${Readings} key=${key} at=${at} uid=${uid} one=${one} />`;
      return html`<${Form} key=${key} at=${at} uid=${uid} one=${one} id=${`${id}-${index}`} whyNot=${whyNot} />`;
    })}
  </section>`;
}

function Readings({ at, uid, one }) {
  useTick(1000);
  const entry = useMetric(at, `mcu/${uid}/${one.name}`);
  const online = useOnline(at);
  const { age = 0, period = 0 } = entry ?? {};
  const repeats = one.kind === "sample" || one.rate_hz > 0; // others are sent when they change
  const gone = Boolean(entry) && isGone({ age, period: repeats ? period : 0 }, online);
  const late = repeats && period > 0 && age > 2 * period + 250;
  const rate = period > 0 && repeats && !gone ? `${plain(Number((1000 / period).toPrecision(2)))}/s` : "";
  const since = entry ? `${roughly(age)} ago` : one.local_only ? "stays on the robot" : "nothing received yet";
  return html`<div class="mcu-out" data-test=${`mcu-out-${one.name}`}>
    <h4>
      ${one.name}${" "}
      <small class=${late ? "late" : ""}>${[one.profile, rate, since].filter(Boolean).join(" · ")}</small>
    </h4>
    <ul>
      ${one.encoding.fields.map((field) => {
        const value = entry && fieldOf(entry.value, field.name);
        return html`<${Reading} key=${field.name} field=${field} value=${value} gone=${gone} />`;
      })}
    </ul>
  </div>`;
}

function Reading({ field, value, gone }) {
  const unit = field.unit ? ` ${field.unit}` : "";
  const words = value === undefined ? "–" : gone ? `– (was ${plain(value)}${unit})` : `${plain(value)}${unit}`;
  return html`<li class="reading"><span class="dim">${field.name}</span><span class=${gone ? "dim" : ""}>${words}</span></li>`;
}

function Form({ at, uid, one, id, whyNot }) {
  const { commands } = usePage();
  const [entered, enter] = useState(/** @type {Map<string, string | boolean>} */ (new Map()));
  const [asked, ask] = useState(/** @type {{at: number, n: number} | null} */ (null));
  const answer = useAnswer(asked?.n);
  const names = isLevel(uid) && isLevel(one.name);
  const own = unsendable(one) || (names ? "" : "its name cannot be part of a topic");
  const why = own || whyNot;
  const send = (event) => {
    event.preventDefault();
    if (why || refuses(event.currentTarget)) return;
    ask({ at: Date.now(), n: commands.commandMcu(at, uid, one.name, command(one, entered)) });
  };
  const change = (name, what) => enter(new Map(entered).set(name, what));
  return html`<form class="mcu-in" data-test=${`mcu-in-${one.name}`} noValidate onSubmit=${send}>
    <h4>${one.name} ${one.profile && html`<small>${one.profile}</small>`}</h4>
    ${one.encoding.fields.map((field) => html`<${Entry} key=${field.name} field=${field} entered=${entered} change=${change} />`)}
    <${Button} type="submit" test=${`send-${one.name}`} label=${`Send ${one.name}`} why=${why} because=${id}>Send<//>
    ${why && html`<${Why} id=${id}>${why}<//>`}
    ${asked &&
    html`<span class=${answer.op === "refused" ? "bad" : "dim"} role="status">${askedWords(answer, asked.at)}</span>`}
  </form>`;
}

/** @param {import("../parts/asking.js").Progress} answer @param {number} at epoch ms */
function askedWords({ op, why }, at) {
  if (op === "refused") return `not done: ${why}`;
  return `${op === "done" ? "sent" : "asked"} at ${clockTime(at)}`;
}

function Entry({ field, entered, change }) {
  const value = entered.get(field.name);
  const label = html`<span>${field.name}${field.unit && html` <small>${field.unit}</small>`}</span>`;
  const test = `field-${field.name}`;
  if (field.type === "bool") {
    const set = (on) => change(field.name, on);
    return html`<${Check} test=${test} role="switch" checked=${value === true} onChange=${set}>${label}<//>`;
  }
  const [least, most] = range(field) ?? [undefined, undefined];
  return html`<label class="mcu-number"
    >${label}<input
      type="number"
      required
      data-test=${test}
      min=${least}
      max=${most}
      step=${step(field)}
      value=${value ?? ""}
      onInput=${(event) => change(field.name, event.currentTarget.value)}
    />
    ${least !== undefined && html`<small>${least} to ${most}</small>`}</label
  >`;
}

// What the gamepad shows, and the wizard that learns what its axes and buttons do. It moves no robot: a panel is open.

import * as browser from "../../core/browser.js";
import { PAD_ACTIONS, buttonName, buttonOf } from "../../core/actions.js";
import { Learning, STEPS } from "../../core/pad-learning.js";
import { PAD_ESTOP } from "../../core/inputs.js";
import { MOST } from "../../core/pad-mapping.js";
import { html, useEffect, useModel, usePage, useState, useTick } from "../parts/hooks.js";
import { pads } from "../parts/pads.js";
import { Panel } from "./panel.js";
import { Why } from "../parts/parts.js";

const SAMPLE_MS = 50;

export function GamepadPanel({ onClose }) {
  const { driver } = usePage();
  useTick(SAMPLE_MS);
  useEffect(() => tryButtons(driver, true));
  useEffect(() => () => tryButtons(driver, false), []);
  const pad = driver.pads?.pad;
  return html`<${Panel} id="gamepad" onClose=${onClose} title="Gamepad">
    ${driver.pads?.reasons().map(({ code, text }) => html`<p key=${text} class="panel-text why" data-test=${`panel-${code}`}>${text}.</p>`)}
    ${driver.pads?.choice.here.length > 1 && html`<${Which} />`}
    ${pad
      ? html`<${Wizard} key=${driver.pads.choice.key} pad=${pad} />`
      : html`<p class="panel-text">
          ${browser.gamepads() === null
            ? "This browser shows no gamepads to this page."
            : "There is no gamepad: connect one, click this page, and press one of its buttons. Browsers show it only then."}
        </p>`}
  <//>`;
}

function Which() {
  const { driver } = usePage();
  return html`<div class="panel-text choices" role="group" aria-label="Gamepads">
    ${driver.pads.choice.here.map(
      ([key, { pad }]) => html`<button
        key=${key}
        type="button"
        class=${key === driver.pads.choice.key ? "primary" : ""}
        aria-pressed=${key === driver.pads.choice.key}
        data-test=${`pad-${pad.index}`}
        onClick=${() => driver.pads.pick(key)}
      >
        ${pad.index + 1}: ${pad.id}
      </button>`,
    )}
    <p class="dim">The one that was touched last drives. One whose stick is never in the middle has to be chosen, and set up.</p>
  </div>`;
}

/** While buttons are tried here, they do nothing else. */
function tryButtons({ actions }, tried) {
  if (actions) actions.padOff = tried;
}

function Wizard({ pad }) {
  const { driver } = usePage();
  const [learning, learn] = useState(/** @type {Learning | null} */ (null));
  useModel(pads);
  useEffect(() => {
    if (!learning) return;
    learning.take(pad, performance.now());
    if (learning.step) return;
    pads.set(pad.id, learning.mapping());
    driver.interrupt(); // what is held now meant something else before
    learn(null);
  });
  const own = pads.mappings.has(pad.id);
  return html`<div class="panel-text">
    <p><b>${pad.id}</b> <span class="dim">${layoutWords(pad, own)}</span></p>
    <${Live} pad=${pad} />
    ${learning
      ? html`<${Question} learning=${learning} onCancel=${() => learn(null)} />`
      : html`<${Summary} pad=${pad} own=${own} onLearn=${() => learn(new Learning(frozen(pad)))} />`}
  </div>`;
}

/** Browsers change a gamepad's values in place. */
const frozen = ({ axes, buttons }) => ({ axes: [...axes], buttons: buttons.map(({ pressed }) => ({ pressed })) });

/** Axes as bars, buttons as lamps. */
function Live({ pad }) {
  return html`<div class="pad-live" aria-hidden="true" data-test="pad-live">
    ${[...pad.axes].slice(0, MOST).map(
      (value, index) => html`<div key=${index} class="pad-axis">
        <span>axis ${index + 1}</span>
        <span class="pad-bar"><i style=${{ left: `${50 + 48 * Math.max(-1, Math.min(1, value || 0))}%` }}></i></span>
        <span>${Number(value || 0).toFixed(2)}</span>
      </div>`,
    )}
    <div class="pad-buttons">
      ${pad.buttons.slice(0, MOST).map((one, index) => html`<kbd key=${index} class=${one.pressed ? "on" : ""}>${index + 1}</kbd>`)}
    </div>
  </div>`;
}

function Question({ learning, onCancel }) {
  const { step, problem, released } = learning;
  if (!step) return null;
  return html`<div class="pad-question">
    <p class="dim">${learning.at + 1} of ${STEPS.length}</p>
    <p role="status" data-test="pad-ask"><b>${released ? step.ask : "Let go"}</b></p>
    <p role="alert" class="bad">${problem}</p>
    <div class="choices">
      ${step.kind === "button" &&
      html`<button type="button" data-test="pad-skip" onClick=${() => learning.skip()}>None for this</button>`}
      <button type="button" data-test="pad-cancel" onClick=${onCancel}>Cancel</button>
    </div>
  </div>`;
}

function Summary({ pad, own, onLearn }) {
  const { driver } = usePage();
  const mapping = pads.mappingOf(pad.id);
  const set = (changed) => {
    pads.set(pad.id, changed);
    driver.interrupt();
  };
  const few = pad.axes.length < 2;
  const percent = Math.round(100 * mapping.deadZone);
  return html`<p data-test="pad-result">${asked(driver.inputs.pad)}</p>
    <p class="dim">
      Let go of everything before you begin. While this panel is open nothing moves; the buttons that stop, stop.
    </p>
    ${few && html`<${Why} id="why-pad">It has no stick: ${pad.axes.length} axes<//>`}
    <div class="choices">
      <button
        type="button"
        class="primary"
        data-test="pad-learn"
        disabled=${few}
        aria-describedby=${few ? "why-pad" : undefined}
        onClick=${onLearn}
      >
        Set it up
      </button>
      ${own &&
      html`<button type="button" data-test="pad-forget" onClick=${() => set(null)}>Usual layout</button>`}
    </div>
    <label class="slider"
      ><span>Dead zone</span>
      <input
        type="range"
        data-test="dead-zone"
        min="5"
        max="50"
        step="1"
        value=${percent}
        aria-valuetext=${`${percent} %`}
        onInput=${(event) => set({ ...mapping, deadZone: Number(event.currentTarget.value) / 100 })}
      />
      <output>${percent} %</output></label
    >
    <dl class="values">
      <div>
        <dt>Forward, right</dt>
        <dd>${[mapping.z, mapping.x].map(axisWords).join(", ")}</dd>
      </div>
      ${PAD_ACTIONS.map(
        (action) => html`<div key=${action.id}>
          <dt>${action.words}</dt>
          <dd>${buttonWords(buttonOf(action, mapping), pad)}</dd>
        </div>`,
      )}
      <div>
        <dt>STOP</dt>
        <dd>${PAD_ESTOP.every((index) => index < pad.buttons.length) ? "buttons 9 and 10 together, always" : "none: it has too few buttons"}</dd>
      </div>
    </dl>`;
}

const layoutWords = ({ mapping, id }, own) => {
  if (own) return "set up in this browser";
  return mapping === "standard" || /attack 3/i.test(id) ? "with the usual layout" : "of an unknown layout, taken for the usual one: set it up";
};

const axisWords = ({ axis, invert }) => `axis ${axis + 1}${invert ? ", reversed" : ""}`;

const buttonWords = (index, pad) =>
  index < 0 || index >= pad.buttons.length ? "none" : buttonName(index, pad.mapping === "standard");

/** What the stick would ask for. */
function asked({ x, z, y }) {
  const part = (value, plus, minus) => (value ? `${value > 0 ? plus : minus} ${Math.round(100 * Math.abs(value))} %` : "");
  const words = [part(z, "forward", "back"), part(x, "right", "left"), part(y, "extra axis +", "extra axis −")];
  return `The stick says: ${words.filter(Boolean).join(", ") || "nothing"}`;
}

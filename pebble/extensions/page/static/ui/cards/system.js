// What can be done to the whole robot: restart, reboot, update; and the flags that allow pictures and sound.

import { scriptName } from "../../core/reasons.js";
import { useAnswer, useWish } from "../parts/asking.js";
import { html, useEffect, usePage, useState, useValue } from "../parts/hooks.js";
import { logViewOf } from "../parts/log-view.js";
import { Panel } from "../panels/panel.js";
import { Button, Check, HoldButton, Why, useName } from "../parts/parts.js";
import { useReasons, whyNot, whyNotEnd } from "../parts/why-not.js";
import { clockTime, driverName } from "../parts/words.js";

/** @typedef {"reboot" | "service-restart" | "git-pull"} Action */

/** @type {Record<Action, {title: string, effects: (name: string) => string[]}>} */
const ACTIONS = {
  "service-restart": {
    title: "Restart Pebble",
    effects: (name) => [
      `All programs of ${name} end and start anew. It is away for some seconds.`,
      "It stops driving; its script, pictures and sound end. A latched stop stays latched.",
    ],
  },
  reboot: {
    title: "Reboot",
    effects: (name) => [
      `The computer of ${name} restarts. It is away for a minute, or longer.`,
      "If it does not come back, you have to go to it.",
    ],
  },
  "git-pull": {
    title: "Update",
    effects: (name) => [
      `${name} fetches new software. It runs after the next restart of Pebble.`,
      "What comes of it is in its log lines.",
    ],
  },
};

export function System({ at, offers, view }) {
  const page = useReasons(at);
  const [asks, ask] = useState(/** @type {Action | ""} */ (""));
  const [asked, set] = useState(/** @type {{action: Action, n: number, at: number} | null} */ (null));
  useEffect(() => {
    ask("");
    set(null);
  }, [at]);
  const held = (action) => {
    set({ action, n: page.commands.act(at, action), at: page.store.now() });
    ask("");
  };
  return html`<div class="system">
    <div class="system-actions">
      ${Object.keys(ACTIONS).map((action) => {
        const why = whyNotAct(page, at, offers, action);
        const id = `why-${action}`;
        return html`<div key=${action}>
          <${Button} test=${action} why=${why} because=${id} onPress=${() => ask(/** @type {Action} */ (action))}>
            ${ACTIONS[action].title}…
          <//>
          ${why && html`<${Why} id=${id}>${why}<//>`}
        </div>`;
      })}
    </div>
    <${AuditButton} at=${at} />
    ${asks && html`<${Ask} at=${at} action=${asks} offers=${offers} onHeld=${() => held(asks)} onClose=${() => ask("")} />`}
    ${asked && html`<${Asked} at=${at} asked=${asked} view=${view} />`}
    <${Flags} at=${at} offers=${offers} />
  </div>`;
}

/** Who did what: fetched when it is asked for. */
function AuditButton({ at }) {
  const page = useReasons(at);
  const [part, show] = useState(/** @type {any} */ (null));
  useEffect(() => show(null), [at]);
  const open = async () => {
    const { Audit } = await import("./audit.js");
    show(() => Audit);
  };
  const why = whyNotEnd(page, "system");
  return html`<div>
    <${Button} test="audit" why=${why} icon="list" onPress=${open}>Who did what…<//>
    ${why && html`<${Why} id="why-audit">${why}<//>`}
    ${part && html`<${part} at=${at} onClose=${() => show(null)} />`}
  </div>`;
}

/** Why an action is off now; "" it is not. */
const whyNotAct = (page, at, offers, action) =>
  whyNot(page, at, "", "system") || lacks(action, offers.known ? offers.value : undefined);

function Ask({ at, action, offers, onHeld, onClose }) {
  const page = useReasons(at);
  const name = useName(at);
  const { title, effects } = ACTIONS[action];
  const why = whyNotAct(page, at, offers, action);
  return html`<${Panel} id="ask" title=${`${title}: ${name}`} onClose=${onClose}>
    <div class="system-ask">
      <ul>
        ${effects(name).map((text) => html`<li key=${text}>${text}</li>`)}
        <${Now} at=${at} />
      </ul>
      <p class="dim">The robot does not acknowledge this: its header says when it is away, and when it is back.</p>
      <${HoldButton} test="ask-hold" disabled=${Boolean(why)} describedBy=${why ? "ask-why" : undefined} onHeld=${onHeld}
        >Hold 1 s: ${title}<//
      >
      ${why && html`<${Why} id="ask-why">${why}<//>`}
      <${Button} test="ask-leave" onPress=${onClose}>Leave it<//>
    </div>
  <//>`;
}

/** Who or what moves it at this moment. */
function Now({ at }) {
  const driver = useValue(at, "web/driver");
  const script = useValue(at, "autonomy-status");
  return html`${driver?.by && !driver.you && html`<li><b>${driverName(driver)} has control of it.</b></li>`}
  ${script?.running === true && html`<li><b>${scriptName(script)} runs.</b></li>`}`;
}

/** What became of the last action, which the robot does not acknowledge: its header and its log lines tell the rest. */
function Asked({ at, asked: { action, n, at: time }, view }) {
  const { store } = usePage();
  const answer = useAnswer(n);
  const refused = n ? answer.op === "refused" && answer.why : "no connection to the server";
  const logs = () => {
    logViewOf(store, at).choose({ service: "", rank: 0, search: action });
    view?.reveal("logs");
  };
  return html`<div class="system-outcome" data-test="outcome">
    <p role="status"><b>${ACTIONS[action].title}:</b> ${refused ? `not asked: ${refused}` : `asked ${clockTime(time)}`}</p>
    <${Button} test="outcome-logs" icon="list" onPress=${logs}>Its log lines<//>
  </div>`;
}

const SPELLINGS = {
  reboot: ["reboot"],
  "service-restart": ["service_restart", "service-restart"],
  "git-pull": ["git_pull", "git-pull"],
};

/**
 * Why a robot does not offer an action, by its capabilities in any of the original's spellings; "" it does. A robot
 * without capabilities is assumed to.
 * @param {Action} action @param {any} capabilities their value; undefined: unknown @returns {string}
 */
export function lacks(action, capabilities) {
  if (!capabilities) return "";
  const { system = {} } = capabilities;
  const entry = SPELLINGS[action].map((name) => system[name] ?? capabilities[name]).find((known) => known !== undefined);
  if (entry === true) return "";
  if (!entry || entry.available === false) return "This robot does not offer it";
  return entry.controls === false ? "Not set up on this robot" : "";
}

// -- flags

const FLAGS = /** @type {const} */ ([
  ["mqtt-video", "mqtt_video", "Pictures", "The camera may run when a page wants its pictures"],
  ["mqtt-audio", "mqtt_audio", "Sound", "Microphone and loudspeaker may run when a page wants them"],
  ["remote-mirror", "remote_mirror", "Mirror", "Commands on the robot's own broker are copied to this one, to debug"],
]);
const ECHO_MS = 5000;

function Flags({ at, offers }) {
  const flags = useValue(at, "web/flags");
  const has = { mqtt_video: offers.hasVideo, mqtt_audio: offers.has("audio"), remote_mirror: offers.section("transport").kind !== "mcu" };
  const shown = FLAGS.filter(([, field]) => has[field] || typeof flags?.[field] === "boolean");
  if (!shown.length) return null;
  return html`<section class="system" aria-labelledby="flags-title">
    <h3 id="flags-title">Allowed</h3>
    ${shown.map(
      ([name, field, title, meaning]) =>
        html`<${Flag} key=${`${at} ${name}`} at=${at} name=${name} title=${title} meaning=${meaning} value=${flags?.[field]} known=${Boolean(flags)} />`,
    )}
  </section>`;
}

function Flag({ at, name, title, meaning, value, known }) {
  const page = useReasons(at);
  const { wish, waits, late, refused, ask } = useWish(value, ECHO_MS);
  const pending = waits && !late ? wish : null;
  const why = whyNotEnd(page, name === "remote-mirror" ? "system" : "drive") || (known ? "" : "Not received yet");
  const change = (on) => ask(on, page.commands.setFlag(at, name, on));
  const id = `flag-${name}`;
  return html`<div class="flag">
    <${Check}
      test=${id}
      role="switch"
      checked=${pending ? pending.on : value === true}
      why=${why}
      aria-describedby=${`${id}-why`}
      onChange=${change}
    >
      ${title}
    <//>
    <span class="flag-state" role="status">${flagWords(late, pending, value, refused)}</span>
    <${Why} id=${`${id}-why`}>${why || meaning}<//>
  </div>`;
}

function flagWords(late, pending, value, refused) {
  const now = value === true ? "on" : value === false ? "off" : "never set";
  if (pending) return `asked: ${pending.on ? "on" : "off"}…`;
  if (refused) return `✖ ${now}; not done: ${refused}`;
  return late ? `✖ not confirmed: ${now}` : now;
}

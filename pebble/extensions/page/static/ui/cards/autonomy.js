// The scripts of a robot: which one runs, and a form to start one.

import { scriptName } from "../../core/reasons.js";
import { useAnswer } from "../parts/asking.js";
import { handDriven, whyNotStarted } from "./autonomy-model.js";
import { filled, moreWords, remember, remembered, scripts } from "./form-model.js";
import { Form } from "./form.js";
import { html, useEffect, useMemo, useMetric, useOnline, useState, useValue } from "../parts/hooks.js";
import { Nothing } from "../parts/nothing.js";
import { Button, Icon, Why, useName } from "../parts/parts.js";
import { refuses } from "../parts/typed.js";
import { useReasons, whyNotEnd } from "../parts/why-not.js";
import { plain, shortTime } from "../parts/more-words.js";

const LONGEST_CONFIG = 14_000; // characters of JSON: the server reads messages of 16 KB

export function Autonomy({ at }) {
  const page = useReasons(at);
  useValue(at, "web/estop");
  useValue(at, "web/driver");
  const payload = useValue(at, "autonomy-files");
  const listed = useMemo(() => scripts(payload), [payload]);
  const entry = useMetric(at, "autonomy-status");
  const status = entry?.value ?? {};
  const [chosen, choose] = useState("");
  const name = useName(at);
  const find = (file) => listed?.find((one) => one.file === file);
  const script = find(chosen);
  const running = plain(find(status.file)?.label ?? scriptName(status));
  const parts = { at, page, entry, status, running };
  const open = (file) => choose(file === chosen ? "" : file);
  return html`<div class="autonomy">
    <${Running} ...${parts} find=${find} />
    ${!listed &&
    html`<${Nothing} icon="script" what="No list of scripts yet">Is autonomy_manager enabled in its config?<//>`}
    ${listed?.length === 0 &&
    html`<${Nothing} icon="script" what=${`${name} has no scripts`}
      >Put a folder with a run.py into its autonomy folder<//
    >`}
    ${Boolean(listed?.length) &&
    html`<ul class="scripts" data-test="scripts">
      ${listed.map((one) => html`<${Row} key=${one.file} ...${parts} script=${one} isOpen=${one === script} onOpen=${open} />`)}
    </ul>`}
  </div>`;
}

/** One script; its form is below it while it is open. */
function Row({ script, isOpen, onOpen, ...parts }) {
  const { file, label, summary } = script;
  return html`<li class=${isOpen ? "open" : ""}>
    <${Button} className="quiet script-row" test=${`script-${file}`} aria-expanded=${isOpen} onPress=${() => onOpen(file)}>
      <span><b>${plain(label)}</b>${summary && html`<small>${plain(summary)}</small>`}</span>
      <${Icon} name=${isOpen ? "up" : "down"} />
    <//>
    ${isOpen && html`<${Starter} ...${parts} script=${script} />`}
  </li>`;
}

/** What a script does, as far as is known. */
function how({ overridden, since }, past) {
  if (overridden) return ", waiting: a person drives";
  if (past) return ", running when it was last seen";
  return `, running${since > 0 ? ` since ${shortTime(1000 * since)}` : ""}`;
}

/** What runs, and the end of it. */
function Running({ at, page, entry, status, running, find }) {
  const called = (file) => plain(find(file)?.label ?? file);
  const why = whyNotEnd(page);
  const past = !useOnline(at);
  const lacking = (status.dependencies ?? []).filter((one) => !one.running);
  return html`<div class="ask-row ask-now">
      <p role="status" data-test="script-state">
        ${status.running
          ? html`<b>${past ? "○" : "●"} ${running}</b>${how(status, past)}`
          : html`<span class="dim">No script runs.</span>`}
      </p>
      ${(status.running || !entry) &&
      html`<${Button} test="end-script" why=${why} icon="halt" onPress=${() => page.commands.stopScript(at)}>Stop script<//>`}
    </div>
    ${why && (status.running || !entry) && html`<${Why} id="why-end-script">${why}<//>`}
    ${status.error &&
    (status.stopped
      ? html`<p class="dim" data-test="script-error">The stop has ended it. Start it again after the reset.</p>`
      : html`<p class="bad" data-test="script-error">✖ ${plain(status.error)}</p>`)}
    ${lacking.map(({ file }) => html`<p key=${file} class="bad">✖ ${called(file)}, which it needs, does not run</p>`)}`;
}

/** The form of one script, and its start. */
function Starter({ at, page, entry, status, running, script }) {
  const [{ texts, version }, set] = useState(() => ({ texts: remembered(at, script.file), version: 0 }));
  const [asked, setAsked] = useState(/** @type {{of: number | undefined, n: number} | null} */ (null));
  const answer = useAnswer(asked?.n);
  const isAsked = asked !== null && entry?.receivedAt === asked.of; // until it reports anything
  useEffect(() => {
    if (answer.op === "done") page.settings.begin("script");
  }, [answer.op]);
  const { main, more } = script;
  const why = whyNotStarted(page, at);
  const { by, waits } = handDriven(page, at);
  const name = useName(at);
  const note = by && waits ? `${by} driving: the script will wait` : `${name} moves by itself${waits ? ". Drive it to interrupt" : ""}`;
  const restore = (event) => {
    event.currentTarget.closest("li").querySelector("button").focus(); // the button vanishes
    change(new Map(), version + 1);
  };
  const change = (next, drawn = version) => {
    set({ texts: next, version: drawn });
    remember(at, script.file, next);
  };
  const onText = (key, text) => {
    const others = [...texts].filter(([one]) => one !== key);
    change(new Map(text === null ? others : [...others, [key, text]]));
  };
  const start = (event) => {
    event.preventDefault();
    if (refuses(event.currentTarget)) return undefined;
    const config = filled(script.fields, texts);
    if (JSON.stringify(config).length > LONGEST_CONFIG) return page.connection.show("Not done: the settings are too long together");
    const n = page.commands.startScript(at, script.file, config);
    remember(at, script.file, texts); // it is the last one now
    return setAsked({ of: entry?.receivedAt, n });
  };
  return html`<form noValidate onSubmit=${start}>
    <${Form} key=${`main ${version}`} id="script-set" fields=${main} texts=${texts} onText=${onText} />
    ${more.length > 0 &&
    html`<details class="script-more">
      <summary data-test="more-settings">${moreWords(more, texts)}</summary>
      <div class="script-more-fields" tabindex="0" role="group" aria-label="More settings">
        <${Form} key=${`more ${version}`} id="script-more" fields=${more} texts=${texts} onText=${onText} />
      </div>
    </details>`}
    <div class="script-start">
      <button class=${why ? "" : "primary"} data-test="start-script" disabled=${Boolean(why)} aria-describedby="why-start">
        <${Icon} name="play" />${startWords(status, script, running)}
      </button>
      <span role="status" class=${answer.op === "refused" ? "bad" : "dim"} data-test="asked"
        >${isAsked && startedWords(answer, name)}</span
      >
      ${texts.size > 0 &&
      html`<${Button} test="restore-all" onPress=${restore}>All defaults<//>`}
      <${Why} id="why-start">${why || note}<//>
    </div>
  </form>`;
}

/** @param {import("../parts/asking.js").Progress} answer @param {string} name */
function startedWords({ op, why }, name) {
  if (op === "refused") return `not done: ${why}`;
  return op === "done" ? `${name} was asked to start it` : "asking…";
}

function startWords({ running, file }, script, other) {
  if (!running) return "Start";
  return file === script.file ? "Start again" : `Start instead of ${other}`;
}

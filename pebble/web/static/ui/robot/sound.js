// Listen to a component, and talk to it: in the bar below its picture, or in a card.

import * as browser from "../../core/browser.js";
import { html, useCalm, useEffect, useModel, usePage, useValue } from "../parts/hooks.js";
import { Icon, Why, useName } from "../parts/parts.js";
import { Sound } from "./sound-model.js";

/** @param {{at: string, place?: "card" | "bar" | "short" | "over"}} props "short": in a bar with little room */
export function SoundControls({ at, place = "card" }) {
  const page = usePage();
  /** @type {Sound} */
  const sound = (page.sound.model ??= new Sound(page));
  useModel(page.connection);
  useModel(sound);
  const view = useValue(at, "web/sound");
  useValue(at, "web/liveness");
  useValue(at, "link");
  useValue("", "web/broker");
  const { listening, muted } = sound;
  const noListening = listening ? "" : sound.listenReason();
  const inBar = place !== "card";
  const short = place === "short";
  const text = words(sound, view, useName(at));
  return html`<div class=${`sound ${inBar ? "in-bar" : ""}`} role="group" aria-label="Sound">
    <div class="sound-buttons">
      <button
        type="button"
        data-test="listen"
        disabled=${noListening !== ""}
        aria-describedby=${noListening ? "why-listen" : undefined}
        onClick=${() => (listening ? sound.stopListening() : sound.listen())}
      >
        <${Icon} name=${listening ? "halt" : "sound"} /><span>${listening ? (inBar ? "Silence" : "Stop listening") : "Listen"}</span>
      </button>
      ${!page.recording && html`<${TalkButton} sound=${sound} noListening=${noListening} short=${short} />`}
      ${listening &&
      (place === "bar" || !inBar) &&
      html`<button type="button" data-test="mute" aria-pressed=${muted} onClick=${() => sound.toggleMute()}>
        <${Icon} name=${muted ? "muted" : "sound"} /><span>${muted ? "Muted" : "Mute"}</span><kbd>M</kbd>
      </button>`}
    </div>
    ${inBar
      ? html`<${Note} sound=${sound} noListening=${noListening} text=${text} />`
      : html`<${Reasons} sound=${sound} noListening=${noListening} /><${State} text=${text} />`}
  </div>`;
}

/** One line in what is left of the bar: why something is off, or is not heard. Numbers are behind the gear. */
function Note({ sound, noListening, text }) {
  const noTalking = sound.talking || usePage().recording ? "" : sound.talkReason();
  const well = text.includes("buffered");
  const said = useCalm(well ? "Listening" : text);
  return html`<p class="bar-note" title=${(well ? "" : text) || noListening || noTalking}>
      <span data-test="sound-note">${well ? "" : text}</span>
      ${noListening && html`<span id="why-listen" class=${text && !well ? "sr" : ""}>${noListening}</span>`}
      ${noTalking &&
      noTalking !== noListening &&
      html`<span id="why-talk" class=${noListening || (text && !well) ? "sr" : ""}>${noTalking}</span>`}
    </p>
    <span class="sr" role="status">${said}</span>`;
}

/** For engineers: how the sound comes now. @param {{at: string}} props */
export function SoundFacts({ at }) {
  const page = usePage();
  /** @type {Sound} */
  const sound = (page.sound.model ??= new Sound(page));
  useModel(sound);
  const view = useValue(at, "web/sound");
  return html`<p class="facts" data-test="sound-state">${words(sound, view, useName(at))}</p>`;
}

/** Numbers are for who asks for them. */
function State({ text }) {
  const words = text.replace(/^.*buffered.*$/, "Listening");
  return html`<p class="sound-state" data-test="sound-state" title=${text === words ? "" : text}>${words}</p>
    <span class="sr" role="status">${useCalm(words)}</span>`;
}

/** Under the buttons that are off; once, if it is the same for both. */
function Reasons({ sound, noListening }) {
  const noTalking = sound.talking || usePage().recording ? "" : sound.talkReason();
  return html`${noListening && html`<${Why} id="why-listen">${noListening}<//>`}
  ${noTalking && noTalking !== noListening && html`<${Why} id="why-talk">${noTalking}<//>`}`;
}

function TalkButton({ sound, noListening, short }) {
  const why = sound.talking ? "" : sound.talkReason();
  const end = () => sound.talk(false);
  useEffect(() => end, []);
  useEffect(() => {
    if (why) end(); // the end of a press on a button that is off is not reported
  }, [why]);
  const isKey = (event) => event.code === "Space" || event.code === "Enter";
  return html`<button
    type="button"
    class=${`talk ${sound.talking?.on ? "on" : ""}`}
    data-test="talk"
    disabled=${why !== ""}
    aria-pressed=${Boolean(sound.talking)}
    aria-describedby=${why ? (why === noListening ? "why-listen" : "why-talk") : undefined}
    onPointerDown=${(event) => {
      if (event.button) return;
      browser.capture(event);
      sound.talk(true);
    }}
    onPointerUp=${end}
    onPointerCancel=${end}
    onLostPointerCapture=${end}
    onBlur=${end}
    onKeyDown=${(event) => isKey(event) && !event.repeat && sound.talk(true)}
    onKeyUp=${(event) => isKey(event) && end()}
    onContextMenu=${(event) => {
      event.preventDefault(); // a finger that stays
      event.stopPropagation();
    }}
  >
    <${Icon} name="mic" /><span>${sound.talking ? "Talking" : short ? "Talk" : "Hold to talk"}</span><kbd>T</kbd>
  </button>`;
}

/** What is heard, or why nothing is. @param {Sound} sound @param {any} view @param {string} name */
function words(sound, view, name) {
  const { talking, listening, stats } = sound;
  if (talking) return talking.on ? `${name} plays your voice.` : "One moment…";
  if (sound.problem || !listening) return sound.problem;
  const muted = sound.muted ? "muted · " : "";
  if (!sound.link.isOpen) return "Connecting…";
  if (view?.state === "refused") return `${name} refuses: ${view.why}`;
  if (["silent", "held"].includes(view?.state)) return `Waits for sound: ${view.why || "none comes"}`;
  if (!stats?.received) return view?.why || "Waits for sound…";
  const lost = stats.lost + stats.refused;
  return `${muted}${stats.bufferedMs} ms buffered · ${stats.encoding} · ${lost ? `${lost} packets lost` : "nothing lost"}`;
}

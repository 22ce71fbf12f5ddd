// Listen to a component, and talk to it: in the bar below its picture, or in a card.

import * as browser from "../../core/browser.js";
import { html, useCalm, useEffect, useModel, usePage, useValue } from "../parts/hooks.js";
import { Icon, Why } from "../parts/parts.js";
import { Sound } from "./sound-model.js";
import { nameOf } from "../parts/words.js";

export function SoundControls({ at }) {
  const page = usePage();
  /** @type {Sound} */
  const sound = (page.sound.model ??= new Sound(page));
  useModel(page.connection);
  useModel(sound);
  const view = useValue(at, "web/sound");
  useValue(at, "web/liveness");
  useValue("", "web/broker");
  const { listening, muted } = sound;
  const noListening = listening ? "" : sound.listenReason();
  return html`<div class="sound" role="group" aria-label="Sound">
    <div class="sound-buttons">
      <button
        type="button"
        data-test="listen"
        disabled=${noListening !== ""}
        aria-describedby=${noListening ? "why-listen" : undefined}
        onClick=${() => (listening ? sound.stopListening() : sound.listen())}
      >
        <${Icon} name=${listening ? "halt" : "sound"} />${listening ? "Stop listening" : "Listen"}
      </button>
      <${TalkButton} sound=${sound} noListening=${noListening} />
      ${listening &&
      html`<button type="button" data-test="mute" aria-pressed=${muted} onClick=${() => sound.toggleMute()}>
        <${Icon} name=${muted ? "muted" : "sound"} />${muted ? "Muted" : "Mute"}<kbd>M</kbd>
      </button>`}
    </div>
    <${Reasons} sound=${sound} noListening=${noListening} />
    <${State} text=${words(sound, view, nameOf(at))} />
  </div>`;
}

/** Numbers are not read aloud. */
function State({ text }) {
  const said = useCalm(text.replace(/^.*buffered.*$/, "Listening"));
  return html`<p class="sound-state" data-test="sound-state">${text}</p>
    <span class="sr" role="status">${said}</span>`;
}

/** Under the buttons that are off; once, if it is the same for both. */
function Reasons({ sound, noListening }) {
  const noTalking = sound.talking ? "" : sound.talkReason();
  return html`${noListening && html`<${Why} id="why-listen">${noListening}<//>`}
  ${noTalking && noTalking !== noListening && html`<${Why} id="why-talk">${noTalking}<//>`}`;
}

function TalkButton({ sound, noListening }) {
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
    <${Icon} name="mic" />${sound.talking ? "Talking" : "Hold to talk"}<kbd>T</kbd>
  </button>`;
}

/** What is heard, or why nothing is. @param {Sound} sound @param {any} view @param {string} name */
function words(sound, view, name) {
  const { talking, listening, stats } = sound;
  if (talking) return talking.on ? `${name} plays your voice.` : "One moment…";
  if (sound.problem || !listening) return sound.problem;
  const muted = sound.muted ? "muted · " : "";
  if (!sound.open) return "Connecting…";
  if (view?.state === "refused") return `${name} refuses: ${view.why}`;
  if (view?.state === "silent") return `Waits for sound: ${view.why || "none comes"}`;
  if (!stats?.received) return view?.why || "Waits for sound…";
  const lost = stats.lost + stats.refused;
  return `${muted}${stats.bufferedMs} ms buffered · ${stats.encoding} · ${lost ? `${lost} packets lost` : "nothing lost"}`;
}

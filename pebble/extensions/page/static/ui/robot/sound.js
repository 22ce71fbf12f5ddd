// Listen to a component, and talk to it: in the bar below its picture, or in a card.

import { html, useCalm, useEffect, useModel, usePage, useValue } from "../parts/hooks.js";
import { Button, held, useName } from "../parts/parts.js";
import { Sound } from "./sound-model.js";

/** @returns {Sound} the page's */
function useSound() {
  const page = usePage();
  return useModel((page.sound.model ??= new Sound(page)));
}

/** @param {{at: string, place?: "card" | "bar" | "short" | "over"}} props "short": in a bar with little room */
export function SoundControls({ at, place = "card" }) {
  const page = usePage();
  const sound = useSound();
  useModel(page.connection);
  const view = useValue(at, "web/sound");
  useValue(at, "web/liveness");
  useValue(at, "link");
  useValue("", "web/broker");
  const { listening, muted } = sound;
  const noListening = listening ? "" : sound.listenReason();
  const noTalking = page.recording || sound.talking ? "" : sound.talkReason();
  const inBar = place !== "card";
  const text = words(sound, view, useName(at));
  const calm = useCalm(text);
  const isHeard = text === LISTENING; // the numbers of that are for who asks for them
  const said = isHeard && inBar ? "" : text;
  const title = isHeard ? numbers(sound) : text || noListening || noTalking;
  return html`<div class=${`sound ${inBar ? "in-bar" : ""}`} role="group" aria-label="Sound">
    <div class="sound-buttons">
      <${Button}
        test="listen"
        why=${noListening}
        icon=${listening ? "halt" : "sound"}
        onPress=${() => (listening ? sound.leave() : sound.listen())}
      >
        <span>${listening ? (inBar ? "Silence" : "Stop listening") : "Listen"}</span>
      <//>
      ${!page.recording &&
      html`<${TalkButton} sound=${sound} why=${noTalking} isSame=${noTalking === noListening} short=${place === "short"} />`}
      ${listening &&
      (place === "bar" || !inBar) &&
      html`<${Button} test="mute" aria-pressed=${muted} icon=${muted ? "muted" : "sound"} onPress=${() => sound.toggleMute()}>
        <span>${muted ? "Muted" : "Mute"}</span><kbd>M</kbd>
      <//>`}
    </div>
    <div class=${inBar ? "bar-note" : "sound-lines"} title=${title}>
      <span class="sound-state" data-test=${inBar ? "sound-note" : "sound-state"} title=${isHeard ? title : undefined}>${said}</span>
      ${noListening && html`<span class=${inBar ? hides(said) : "why"} id="why-listen">${noListening}</span>`}
      ${noTalking &&
      noTalking !== noListening &&
      html`<span class=${inBar ? hides(said || noListening) : "why"} id="why-talk">${noTalking}</span>`}
    </div>
    <span class="sr" role="status">${calm}</span>
  </div>`;
}

/** A bar has room for one line: others are only read aloud. @param {string} first */
const hides = (first) => (first ? "sr" : "");

/** For engineers: how the sound comes now. @param {{at: string}} props */
export function SoundFacts({ at }) {
  const sound = useSound();
  const view = useValue(at, "web/sound");
  const text = words(sound, view, useName(at));
  return html`<p class="facts" data-test="sound-state">${text === LISTENING ? numbers(sound) : text}</p>`;
}

/** ``isSame``: listening is off for the same reason. */
function TalkButton({ sound, why, isSame, short }) {
  const end = () => sound.talk(false);
  useEffect(() => end, []);
  useEffect(() => {
    if (why) end(); // the end of a press on a button that is off is not reported
  }, [why]);
  return html`<${Button}
    className=${`talk ${sound.talking?.on ? "on" : ""}`}
    test="talk"
    why=${why}
    because=${isSame ? "why-listen" : "why-talk"}
    icon="mic"
    aria-pressed=${Boolean(sound.talking)}
    ...${held(() => sound.talk(true), end, true)}
    onContextMenu=${(event) => {
      event.preventDefault(); // a finger that stays
      event.stopPropagation();
    }}
  >
    <span>${sound.talking ? "Talking" : short ? "Talk" : "Hold to talk"}</span><kbd>T</kbd>
  <//>`;
}

const LISTENING = "Listening";

/** What is heard, or why nothing is. @param {Sound} sound @param {any} view @param {string} name */
function words(sound, view, name) {
  const { talking, listening, link: { stats } } = sound;
  if (talking) return talking.on ? `${name} plays your voice.` : "One moment…";
  if (sound.problem || !listening) return sound.problem;
  if (!sound.link.isOpen) return "Connecting…";
  if (view?.state === "refused") return `${name} refuses: ${view.why}`;
  if (["silent", "held"].includes(view?.state)) return `Waits for sound: ${view.why || "none comes"}`;
  return stats?.received ? LISTENING : view?.why || "Waits for sound…";
}

/** How it is heard. @param {Sound} sound */
function numbers({ muted, link: { stats } }) {
  const lost = stats.lost + stats.refused;
  const words = [muted && "muted", `${stats.bufferedMs} ms buffered`, stats.encoding, lost ? `${lost} packets lost` : "nothing lost"];
  return words.filter(Boolean).join(" · ");
}

// The recorded picture, and what plays it.

import * as browser from "../../core/browser.js";
import { Bands } from "../banner.js";
import { SPEEDS } from "../../core/replay/player.js";
import { whyOf } from "../../core/replay/timeline.js";
import { Page, html, useEffect, useModel, useRef, useTick } from "../parts/hooks.js";
import { Icon, Why, useName } from "../parts/parts.js";
import { Drawn, StillTools } from "../robot/picture-extras.js";
import { clockTime, span } from "../parts/words.js";

const WAIT_SHOWN_MS = 400;
const OLD_MS = 2000; // as of a live picture

/** ``live``: the services of the page itself: what must not be overlooked is of now. */
export function Picture({ at, replay, live }) {
  useModel(replay);
  useTick(100);
  const place = useRef(null);
  const { video, player } = replay;
  const name = useName(at);
  useEffect(() => {
    place.current.append(video.canvas);
    return () => video.canvas.remove();
  }, [video]);
  video.canvas.setAttribute("role", "img");
  video.canvas.setAttribute("aria-label", `What ${name} saw`);
  const { info } = video;
  const cover = coverOf(replay);
  return html`<section class=${`stage ${cover ? "stale" : ""} ${info ? "" : "blank"}`} aria-label="Recorded picture">
    <div class="picture">
      <div class="canvas" ref=${place}></div>
      <${Page.Provider} value=${live}><${Bands} at="" /><//>
      <${Drawn} source=${at} />
      ${cover && html`<p class="cover" data-test="cover">${cover}</p>`}
      ${info && html`<span class="tag tag-how">${`${info.encoding} ${info.width}×${info.height}`}</span>`}
      ${info && html`<span class="tag tag-age" data-test="picture-time">recorded ${stamp(takenAt(info))}</span>`}
    </div>
    <${Notes} replay=${replay} />
    <${Bar} at=${at} replay=${replay} player=${player} />
  </section>`;
}

/** When it was taken, by the robot's clock; else when it was received. @param {any} info */
const takenAt = ({ capturedMs, receivedMs }) =>
  capturedMs !== null && Math.abs(capturedMs - receivedMs) < 3_600_000 ? capturedMs : receivedMs;

/** @param {number} ms @returns {string} 10:03:12.345 */
export const stamp = (ms) => `${clockTime(ms)}.${String(Math.floor(ms) % 1000).padStart(3, "0")}`;

/** Why there is no picture of this time; "" there is. */
function coverOf({ player, video, pictures }) {
  if (player.refused && player.problem) return player.problem;
  if (player.seeking) return performance.now() - player.soughtAt > WAIT_SHOWN_MS ? "Loading…" : "";
  if (pictures.problem && !video.info) return pictures.problem;
  if (!video.info) return "No picture was recorded here";
  const old = player.position - video.info.receivedMs;
  return old > OLD_MS ? `No picture was recorded here · this one is ${span(old)} older` : "";
}

/** What was left out, and what goes wrong. */
function Notes({ replay }) {
  const { player, timeline } = replay;
  const { skipped } = player;
  const why = skipped && whyOf(timeline?.gaps ?? [], skipped);
  const note = skipped && `Skipped ${long(skipped.until - skipped.since)}: ${why || "nothing was recorded"}`;
  const problem = !player.refused && player.problem ? `${player.problem}. Trying again…` : player.warning;
  return html`<div class="replay-notes" role="status">
    ${note && html`<p data-test="skipped">${note}</p>`} ${problem && html`<p class="bad" data-test="problem">✖ ${problem}</p>`}
  </div>`;
}

/** @param {number} ms @returns {string} 3 min 20 s */
export function long(ms) {
  const s = Math.round(ms / 1000);
  const parts = [[Math.floor(s / 3600), "h"], [Math.floor(s / 60) % 60, "min"], [s % 60, "s"]];
  return parts.filter(([count]) => count).map(([count, unit]) => `${count} ${unit}`).join(" ") || "0 s";
}

function Bar({ at, replay, player }) {
  const words = player.seeking || player.waiting ? "loading…" : player.ended ? "end of the recording" : "";
  return html`<div class="picture-bar replay-bar">
    <div class="replay-keys" role="group" aria-label="Play">
      <button type="button" data-test="back-10" aria-label="Back: −10 s" onClick=${() => replay.step(-10_000)}>−10 s</button>
      <button type="button" class="primary" data-test="play" onClick=${() => replay.toggle()}>
        <${Icon} name=${player.playing ? "pause" : "play"} />${player.playing ? "Pause" : "Play"}
      </button>
      <button type="button" data-test="on-10" aria-label="Forward: +10 s" onClick=${() => replay.step(10_000)}>+10 s</button>
    </div>
    <select
      data-test="speed"
      aria-label="Speed"
      value=${String(player.speed)}
      onChange=${(event) => player.setSpeed(Number(event.currentTarget.value))}
    >
      ${SPEEDS.map((speed) => html`<option key=${speed} value=${speed}>×${speed}</option>`)}
    </select>
    <div class="replay-keys" role="group" aria-label="One picture">
      <button type="button" data-test="picture-back" aria-label="One picture back" onClick=${() => replay.stepPicture(-1)}><${Icon} name="back" /><kbd>,</kbd></button>
      <button type="button" data-test="picture-on" class="turned" aria-label="One picture on" onClick=${() => replay.stepPicture(1)}><${Icon} name="back" /><kbd>.</kbd></button>
    </div>
    <output class="replay-time" data-test="time">${player.seeks ? stamp(player.position) : "–"} <small>${words}</small></output>
    <div class="replay-tools"><${Listen} sound=${replay.sound} player=${player} /><${StillTools} source=${at} /></div>
  </div>`;
}

function Listen({ sound, player }) {
  const silent = player.seeks && !sound.packets ? "No sound was recorded here" : "";
  const why = player.speed !== 1 ? "Sound is played at speed ×1 only" : sound.problem || (sound.on ? silent : "");
  const off = !sound.on && !browser.find("AudioContext") ? "This browser plays no sound" : "";
  return html`<span class="replay-sound"
    ><button
      type="button"
      data-test="replay-sound"
      aria-pressed=${sound.on}
      disabled=${off !== ""}
      aria-describedby=${off || why ? "why-replay-sound" : undefined}
      onClick=${() => (sound.on ? sound.stop() : sound.start())}
    >
      <${Icon} name=${sound.on && !why ? "sound" : "muted"} />${sound.on ? "Sound on" : "Sound off"}</button
    >${(off || why) && html`<${Why} id="why-replay-sound">${off || why}<//>`}</span
  >`;
}

// The picture of a recording, in the place of the live one.

import { EXTRAS, VOICE } from "../cards/cards.js";
import { Boundary, html, useLayoutEffect, useModel, usePage, useRef, useTick } from "../parts/hooks.js";
import { Extra, Part, useName } from "../parts/parts.js";
import { clockTime } from "../parts/words.js";

/** @param {number} ms @returns {string} 10:03:12.345 */
export const stamp = (ms) => `${clockTime(ms)}.${String(Math.floor(ms) % 1000).padStart(3, "0")}`;

/** When it was taken, by the robot's clock; else when it was received. @param {any} info */
const takenAt = ({ capturedMs, receivedMs }) =>
  capturedMs !== null && Math.abs(capturedMs - receivedMs) < 3_600_000 ? capturedMs : receivedMs;

export function RecordedStage({ at, offers, layout }) {
  const { recording, video } = usePage();
  useModel(recording);
  useTick(200);
  const place = useRef(null);
  const name = useName(at);
  useLayoutEffect(() => {
    place.current.append(video.canvas);
    video.canvas.setAttribute("role", "img");
    video.canvas.setAttribute("aria-label", `What ${name} saw`);
  }, [name]);
  const { cover } = recording;
  const short = layout === "portrait" ? "short" : "bar";
  return html`<section
    class=${`stage ${cover ? "stale" : ""} ${video.info ? "" : "blank"}`}
    aria-label="Recorded picture"
    data-card="picture"
    data-span="main"
  >
    <div class="picture">
      <div class="canvas" ref=${place}></div>
      <${Extra} of=${EXTRAS} part="Drawn" what="What is drawn over it" source=${at} />
      ${cover && html`<p class="cover" data-test="cover">${cover}</p>`}
      ${video.info && html`<span class="tag tag-age" data-test="picture-time">recorded ${stamp(takenAt(video.info))}</span>`}
    </div>
    <div class="picture-bar" role="group" aria-label="Picture and sound">
      <${Extra} of=${EXTRAS} part="StillTools" what="Snapshots" source=${at} />
      ${offers.has("audio") &&
      html`<${Boundary} what="Sound"><${Part} part=${VOICE} lines=${0} at=${at} place=${short} /><//>`}
    </div>
  </section>`;
}

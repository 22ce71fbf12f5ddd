// The picture of a recording, in the place of the live one.

import { EXTRAS, VOICE } from "../cards/cards.js";
import { Boundary, html, useModel, usePage, useTick } from "../parts/hooks.js";
import { Extra, Part, useName } from "../parts/parts.js";
import { exactTime } from "../parts/more-words.js";
import { Frame, SnapshotButton } from "../robot/video.js";

/** When it was taken, by the robot's clock; else when it was received. @param {any} info */
const takenAt = ({ capturedMs, receivedMs }) =>
  capturedMs !== null && Math.abs(capturedMs - receivedMs) < 3_600_000 ? capturedMs : receivedMs;

export function RecordedStage({ at, offers, layout }) {
  const { recording, video } = usePage();
  useModel(recording);
  useTick(200);
  const { cover } = recording;
  const short = layout === "portrait";
  const over =
    video.info && html`<span class="tag tag-age" data-test="picture-time">recorded ${exactTime(takenAt(video.info))}</span>`;
  return html`<${Frame} label="Recorded picture" alt=${`What ${useName(at)} saw`} part="Drawn" source=${at} cover=${cover} over=${over}>
    <div class="picture-bar" role="group" aria-label="Picture and sound">
      <${SnapshotButton} source=${at} short=${short} />
      <${Extra} of=${EXTRAS} part="Marks" what="Marks of scripts" source=${at} />
      ${offers.has("audio") &&
      html`<${Boundary} what="Sound"><${Part} part=${VOICE} lines=${0} at=${at} place=${short ? "short" : "bar"} /><//>`}
    </div>
  <//>`;
}

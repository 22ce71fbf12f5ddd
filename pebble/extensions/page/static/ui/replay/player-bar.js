// What plays a recording: one bar with marks, the time, the speed, and where else to go.

import { SPEEDS } from "../../core/replay/feed.js";
import { MARKS, extentOf, holding, stretchesOf, whyOf } from "../../core/replay/timeline.js";
import { html, useMemo, useModel, useState, useTick } from "../parts/hooks.js";
import { Button, Select } from "../parts/parts.js";
import { exactTime, shortTime } from "../parts/more-words.js";
import { clockTime, span } from "../parts/words.js";
import { Elsewhere, Sessions } from "./choose.js";
import { Download } from "./download.js";

const PATIENCE_MS = 3000;
const PANELS = { days: ["Days", "list"], download: ["Download", "save"] };

export function PlayerBar({ at, replay }) {
  useModel(replay);
  useTick(100);
  const [open, show] = useState("");
  const [isNear, setNear] = useState(false);
  const { feed, day } = replay;
  const { on, speed, ended } = feed.played;
  const words = feed.seeking ? "loading…" : ended ? "end of the recording" : "";
  const { skipped } = feed;
  const session = holding(day.sessions, feed.position);
  const seen = day.timeline && (isNear && session ? session : extentOf(day.timeline, day.name));
  const marks = useMemo(() => (day.timeline && seen ? marksOf(day.timeline, seen) : []), [day.timeline, seen?.since, seen?.until]);
  const why = skipped && whyOf(day.timeline?.gaps ?? [], skipped);
  return html`<section class="card player" aria-label="What plays the recording">
    ${open === "days" &&
    html`<div class="player-panel"><${Elsewhere} at=${at} replay=${replay} /><${Sessions} replay=${replay} />
      <${Legend} marks=${marks} />
    </div>`}
    ${open === "download" && html`<div class="player-panel"><${Download} replay=${replay} /></div>`}
    ${skipped &&
    html`<p class="player-note" role="status" data-test="skipped">
      Skipped ${span(skipped.until - skipped.since)}: ${why || "nothing was recorded"}
    </p>`}
    ${seen ? html`<${Marks} replay=${replay} marks=${marks} seen=${seen} />` : html`<${NoDay} replay=${replay} />`}
    <div class="player-keys" role="group" aria-label="Play">
      <${Button} test="back-10" label="Back: −10 s" onPress=${() => replay.step(-10_000)}>−10 s<//>
      <${Button} className="primary" test="play" icon=${on ? "pause" : "play"} onPress=${() => replay.toggle()}>${on ? "Pause" : "Play"}<//>
      <${Button} test="on-10" label="Forward: +10 s" onPress=${() => replay.step(10_000)}>+10 s<//>
      <${Select}
        test="speed"
        label="Speed"
        value=${String(speed)}
        choices=${SPEEDS.map((factor) => [factor, `×${factor}`])}
        onChoose=${(factor) => feed.setSpeed(Number(factor))}
      />
      <output class="player-time" data-test="time">${feed.seeks ? exactTime(feed.position) : "–"} <small>${words}</small></output>
      ${session &&
      html`<${Button} test="near" aria-pressed=${isNear} icon="full" onPress=${() => setNear(!isNear)}>Session<//>`}
      ${Object.entries(PANELS).map(
        ([name, [title, icon]]) => html`<${Button}
          key=${name}
          test=${`open-${name}`}
          aria-expanded=${open === name}
          icon=${icon}
          onPress=${() => show(open === name ? "" : name)}
        >
          ${title}
        <//>`,
      )}
    </div>
  </section>`;
}

/** The day, or one session of it: a slider over what was going on. */
function Marks({ replay, marks, seen }) {
  const { feed, marked } = replay;
  const all = Object.keys(marked).length ? [...marks, { ...replay.stretch, id: "marked", title: "marked" }] : marks;
  const place = ({ since, until }) => {
    const [from, to] = [since, until].map((ms) => Math.min(1, Math.max(0, (ms - seen.since) / (seen.until - seen.since))));
    return { left: `${(100 * from).toFixed(3)}%`, width: `max(2px, ${(100 * (to - from)).toFixed(3)}%)` };
  };
  return html`<div class="player-marks">
      ${all.map((mark) => html`<i key=${`${mark.id} ${mark.since}`} class=${`mark ${mark.id}`} style=${place(mark)}></i>`)}
      <input
        type="range"
        data-test="bar"
        aria-label="Time of the recording"
        aria-valuetext=${clockTime(feed.position)}
        min=${seen.since}
        max=${seen.until}
        step="100"
        value=${Math.round(feed.position)}
        onInput=${(event) => replay.seek(Number(event.currentTarget.value))}
      />
    </div>
    <div class="player-scale">
      <span>${shortTime(seen.since)}</span><${Legend} marks=${all} /><span>${shortTime(seen.until)}</span>
    </div>`;
}

/** What the marks mean. On a phone it is only with the days. */
const Legend = ({ marks }) => html`<ul class="legend">
  ${[...new Map(marks.map(({ id, title }) => [id, title]))].map(
    ([id, title]) => html`<li key=${id}><i class=${`mark ${id}`}></i>${title}</li>`,
  )}
</ul>`;

/** @param {import("../../core/replay/archive.js").Timeline} timeline @param {{since: number, until: number}} seen */
function marksOf(timeline, seen) {
  const { gaps, outages, sessions } = timeline;
  const inside = ({ since, until }) => since < seen.until && until > seen.since;
  const named = (list, id, title) => list.filter(inside).map((stretch) => ({ ...stretch, id, title }));
  return [
    ...named(sessions, "used", "used"),
    ...MARKS.flatMap(({ bit, id, title }) => named(stretchesOf(timeline, bit, seen), id, title)),
    ...named(outages, "outage", `robot silent (${outages.length})`),
    ...named(gaps, "gap", `not recorded (${gaps.length})`),
  ];
}

/** In place of the marks of a day that is not here: its shape, and what is done once that takes long and goes on. */
function NoDay({ replay }) {
  const { day } = replay;
  const words = day.indexing > 0 && performance.now() - day.openedAt > PATIENCE_MS ? `Reading the day: ${Math.round(100 * day.indexing)} %` : "";
  const again = () => (day.name ? day.open(day.name, day.then, true) : replay.start());
  return html`<div class="player-marks loading">${!day.problem && html`<i class="bone" aria-hidden="true"></i>`}</div>
  <div class="player-scale" role="status">
    <span>${day.problem ? `✖ ${day.problem}` : words}</span>
    ${day.problem && html`<${Button} test="try-again" onPress=${again}>Try again<//>`}
  </div>`;
}

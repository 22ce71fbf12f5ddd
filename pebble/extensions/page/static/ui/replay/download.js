// A stretch of the recording as a film, or as it was recorded.

import { Archive, delay } from "../../core/replay/archive.js";
import { html, useEffect, useRef, useState } from "../parts/hooks.js";
import { Button, Select, Why } from "../parts/parts.js";
import { clockTime, span } from "../parts/words.js";
import { sizeWords } from "./choose.js";

const POLL_MS = 500;
const LONGEST_MS = 3_600_000;
const FORMS = { mkv: "Film (MKV)", mp4: "Film (MP4)", mcap: "Raw (MCAP)" };

/** One export at a time, from the request to its file. */
function useExport(replay) {
  const [job, setJob] = useState(/** @type {any} */ (null)); // {id, state, done, why, name, bytes}
  const current = useRef(/** @type {{id: string, abort: AbortController} | null} */ (null));
  const { archive } = replay.day;
  const end = () => {
    const job = current.current;
    current.current = null;
    job?.abort.abort();
    if (job?.id) archive.end(job.id).catch(() => {}); // it has ended by itself
    setJob(null);
  };
  const begin = async (stretch, as) => {
    end();
    const mine = { id: "", abort: new AbortController() };
    current.current = mine;
    setJob({ state: "running", done: 0 });
    try {
      mine.id = await archive.begin(replay.ref, stretch, as);
      if (current.current !== mine) return await archive.end(mine.id); // cancelled meanwhile
      for (let state = "running"; state === "running"; ) {
        await delay(POLL_MS, mine.abort.signal);
        const job = await archive.progress(mine.id, mine.abort.signal);
        state = job.state;
        setJob({ ...job, id: mine.id });
      }
    } catch (error) {
      if (current.current === mine) setJob({ state: "failed", why: /** @type {Error} */ (error).message });
    }
  };
  useEffect(() => end, []);
  return { job, begin, end };
}

export function Download({ replay }) {
  const [as, choose] = useState("mkv");
  const { job, begin, end } = useExport(replay);
  const { feed, stretch } = replay;
  const isMarked = Object.keys(replay.marked).length > 0;
  const lasts = stretch.until - stretch.since;
  const running = job?.state === "running";
  const why = feed.seeks ? (lasts > LONGEST_MS ? "At most one hour: mark a shorter stretch" : "") : "Nothing is open yet";
  const off = why || (running ? "One download is being made" : "");
  return html`<div class="download">
    <p>
      <b data-test="stretch">${feed.seeks ? `${clockTime(stretch.since)} – ${clockTime(stretch.until)}` : "–"}</b>
      <span class="dim"> ${feed.seeks && span(lasts)}</span>
    </p>
    <div class="download-marks">
      <${Button} test="mark-in" onPress=${() => replay.mark({ since: feed.position })}>Start here<//>
      <${Button} test="mark-out" onPress=${() => replay.mark({ until: feed.position })}>End here<//>
      ${isMarked && html`<${Button} className="quiet" test="mark-clear" onPress=${() => replay.unmark()}>Clear<//>`}
    </div>
    <div class="download-marks">
      <${Select} test="download-as" label="Form of the download" value=${as} choices=${Object.entries(FORMS)} onChoose=${choose} />
      <${Button} test="download" why=${off} icon="save" onPress=${() => begin(stretch, as)}>Prepare download<//>
    </div>
    ${off && html`<${Why} id="why-download">${off}<//>`}
    ${job && html`<${Job} job=${job} onEnd=${end} />`}
  </div>`;
}

function Job({ job, onEnd }) {
  if (job.state === "failed") return html`<p class="bad" role="alert" data-test="download-failed">✖ Not made: ${job.why}</p>`;
  if (job.state === "ready") {
    return html`<p class="download-job" role="status">
      <a class="button primary" data-test="download-file" href=${Archive.file(job.id)} download=${job.name}>Save ${job.name}</a>
      <span class="dim">${sizeWords(job.bytes)}</span>
      ${job.why && html`<span class="bad">Not all could be read: ${job.why}</span>`}
      <${Button} className="quiet" test="download-end" onPress=${onEnd}>Remove<//>
    </p>`;
  }
  const share = Math.round(100 * (job.done ?? 0));
  return html`<p class="download-job">
    <progress max="100" value=${share} aria-label="Progress of the download"></progress>
    <span data-test="download-share">${share} %</span>
    <${Button} test="download-end" onPress=${onEnd}>Cancel<//>
  </p>`;
}

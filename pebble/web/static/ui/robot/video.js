// The live picture: how old it is, how it comes, and where from.

import * as browser from "../../core/browser.js";
import { EXTRAS, PICTURE, VOICE } from "../cards/cards.js";
import { Boundary, html, useEffect, useModel, usePage, useRef, useState, useTick, useValue } from "../parts/hooks.js";
import { Extra, Icon, Part } from "../parts/parts.js";
import { nameOf, span } from "../parts/words.js";

/** Show pictures of ``source`` as long as this is on the page. @param {string} at @param {string} source "": none */
export function useVideo(at, source) {
  const { settings, video, driver } = usePage();
  const [wanted, want] = useState(() => settings.wantsVideo(at));
  useEffect(() => {
    video.show(wanted ? source : "");
    driver.changed();
    return () => video.show("");
  }, [source, wanted]);
  return {
    wanted,
    toggle() {
      settings.setVideo(at, !wanted);
      want(!wanted);
    },
  };
}

export function Stage({ at, video: control, source, offers, wide = false, immersive = false }) {
  const page = usePage();
  const { video } = page;
  useModel(video);
  useTick(200);
  const place = useRef(null);
  useEffect(() => {
    const { current } = place;
    current.append(video.canvas);
    return () => {
      if (video.canvas.parentNode === current) video.canvas.remove(); // another layout may have it already
    };
  }, []);
  const cover = useCover(control, source);
  const stale = cover !== "";
  const info = video.stream ? null : video.info;
  const view = useValue(source, "web/picture");
  video.canvas.setAttribute("role", "img");
  video.canvas.setAttribute("aria-label", `What ${nameOf(source)} sees`);
  return html`<section class=${`stage ${stale ? "stale" : ""} ${video.info ? "" : "blank"}`} aria-label="Live picture">
    <div class="picture">
      <div class="canvas" ref=${place}></div>
      <${Extra} of=${EXTRAS} part="Layer" what="What is drawn over it" source=${source} />
      ${cover && html`<p class="cover" data-test="cover">${cover}</p>`}
      ${info && html`<span class="tag tag-how">${howWords(video, view)}</span>`}
      ${info && html`<span class=${`tag tag-age ${stale ? "bad" : ""}`}>${ageWords(video)}</span>`}
      ${source !== at && html`<span class="tag tag-from">seen from ${nameOf(source)}</span>`}
    </div>
    ${!immersive &&
    html`<div class="picture-bar">
      <button type="button" data-test="video" onClick=${control.toggle}>
        <${Icon} name=${control.wanted ? "no-camera" : "camera"} />${control.wanted ? "Stop video" : "Start video"}
      </button>
      <button
        type="button"
        data-test="full-screen"
        hidden=${!browser.fullScreen.possible}
        onClick=${() => browser.fullScreen.toggle()}
      >
        <${Icon} name=${browser.fullScreen.on ? "small" : "full"} />${browser.fullScreen.on
          ? "Leave full screen"
          : "Full screen"}
      </button>
      <${Extra} of=${EXTRAS} part="Tools" what="More of the picture" source=${source} wanted=${control.wanted} />
      ${wide && html`<${Part} part=${PICTURE} at=${at} source=${source} offers=${offers} />`}
      ${wide && offers.has("audio") && html`<${Boundary} what="Sound"><${Part} part=${VOICE} at=${at} /><//>`}
    </div>`}
  </section>`;
}

/** Why there is no live picture; "" there is. */
function useCover(control, source) {
  const { connection, video } = usePage();
  useModel(connection);
  const view = useValue(source, "web/picture");
  const online = useValue(source, "web/liveness")?.online;
  if (!control.wanted) return "Video is stopped";
  if (video.stream) return "";
  const old = video.info ? ` · this picture is ${span(video.age().ms)} old` : "";
  if (!connection.isOpen) return `No connection to the server${old}`;
  if (video.info && !video.isStale) return "";
  if (video.info && !video.hasStopped) return `The pictures come late${old}`;
  if (online === false) return `${nameOf(source)} is silent${old}`;
  if (view?.state === "refused") return `No picture: ${view.why || "the robot refuses"}`;
  if (video.info) return `The picture has stopped${old}`;
  if (view?.why) return view.why;
  return view?.state === "silent" ? "The camera sends nothing" : "Waiting for the first picture…";
}

function howWords({ info, interval }, view) {
  const size = `${info.encoding ?? ""}${info.rescue ? " (converted)" : ""} ${info.width}×${info.height}`;
  const rate = view?.per_second > 0 ? view.per_second : interval > 0 ? 1000 / interval : 0;
  const bits = view?.kbits > 0 ? ` · ${Math.round(view.kbits)} kbit/s` : "";
  const viewers = view?.viewers > 1 ? ` · ${view.viewers} viewers` : "";
  return `${size} · ${rate.toFixed(rate < 9.5 ? 1 : 0)}/s${bits}${viewers}`;
}

function ageWords(video) {
  const { ms, since } = video.age();
  return since === "taken" ? `${span(ms)} old` : `arrived ${span(ms)} ago`;
}

// The live picture: how old it is, how it comes, and where from.

import { VOICE } from "./cards.js";
import {
  html,
  styled,
  useEffect,
  useModel,
  usePage,
  usePart,
  useRef,
  useRefs,
  useState,
  useTick,
  useValue,
} from "./hooks.js";
import { Offers } from "./models.js";
import { Icon, Part, Why } from "./parts.js";
import { nameOf, span } from "./words.js";

const ENCODINGS = ["h264", "pbvz", "pbvd", "json", "jpeg"];

const EXTRAS = styled(() => import("./picture-extras.js"), "picture.css");

/** What belongs to a picture besides it, as soon as it was fetched. @param {any} props */
function Extra({ part, ...props }) {
  const { body } = usePart(EXTRAS);
  return body ? html`<${body[part]} ...${props} />` : null;
}

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
  video.canvas.setAttribute("role", "img");
  video.canvas.setAttribute("aria-label", `What ${nameOf(source)} sees`);
  return html`<section class=${`stage ${stale ? "stale" : ""} ${video.info ? "" : "blank"}`} aria-label="Live picture">
    <div class="picture">
      <div class="canvas" ref=${place}></div>
      <${Extra} part="Layer" source=${source} />
      ${cover && html`<p class="cover" data-test="cover">${cover}</p>`}
      ${info && html`<span class="tag tag-how">${howWords(video, useValue(source, "web/picture"))}</span>`}
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
        hidden=${!document.documentElement.requestFullscreen}
        onClick=${toggleFull}
      >
        <${Icon} name=${document.fullscreenElement ? "small" : "full"} />${document.fullscreenElement
          ? "Leave full screen"
          : "Full screen"}
      </button>
      <${Extra} part="Tools" source=${source} wanted=${control.wanted} />
      ${wide && html`<${PictureSettings} at=${at} source=${source} offers=${offers} />`}
      ${wide && offers.has("audio") && html`<${Part} part=${VOICE} at=${at} />`}
    </div>`}
  </section>`;
}

const toggleFull = () =>
  (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()).catch(() => {});

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

/** Encoding and source; they count for everybody who looks at this component. */
export function PictureSettings({ at, source, offers, video }) {
  const { commands, connection } = usePage();
  useModel(connection);
  const view = useValue(source, "web/picture");
  const listed = offers.section("video").encodings;
  const encodings = ENCODINGS.filter((one) => !Array.isArray(listed) || listed.includes(one) || one === view?.pinned);
  const may = connection.may("drive") ? "" : "Log in as driver to change";
  const why = connection.isOpen ? may : "No connection to the server";
  const more = { disabled: Boolean(why), "aria-describedby": why ? "why-picture" : undefined };
  return html`<div class="picture-settings">
    ${video &&
    html`<button type="button" data-test="video" onClick=${video.toggle}>
        ${video.wanted ? "Stop video" : "Start video"}
      </button>
      <${Extra} part="Tools" source=${source} wanted=${video.wanted} />`}
    <label class="field"
      ><span>Encoding</span>
      <select
        data-test="encoding"
        value=${view?.pinned ?? ""}
        ...${more}
        onChange=${(event) => commands.setEncoding(source, event.currentTarget.value)}
      >
        <option value="">automatic</option>
        ${encodings.map((one) => html`<option key=${one} value=${one}>${one}</option>`)}
      </select></label
    >
    <${PictureFrom} at=${at} source=${source} offers=${offers} more=${more} />
    ${why && html`<${Why} id="why-picture">${why}<//>`}
  </div>`;
}

/** For a component without a camera: another one may look at it. */
export function NoCamera({ at, offers }) {
  const { connection } = usePage();
  useModel(connection);
  if (useCameras(at).length === 0) return null;
  const may = connection.may("drive") ? "" : "Log in as driver to choose one";
  const why = connection.isOpen ? may : "No connection to the server";
  const more = { disabled: Boolean(why), "aria-describedby": why ? "why-picture" : undefined };
  return html`<section class="no-camera picture-settings" aria-label="Picture">
    <p>${nameOf(at)} has no camera.</p>
    <${PictureFrom} at=${at} source=${at} offers=${offers} more=${more} />
    ${why && html`<${Why} id="why-picture">${why}<//>`}
  </section>`;
}

function PictureFrom({ at, source, offers, more }) {
  const { commands } = usePage();
  const cameras = useCameras(at);
  if (!cameras.length) return null;
  return html`<label class="field"
    ><span>Picture from</span>
    <select
      data-test="picture-from"
      value=${source === at ? "" : source}
      ...${more}
      onChange=${(event) => commands.setPictureFrom(at, event.currentTarget.value)}
    >
      <option value="">${offers.hasVideo ? "its own camera" : "nowhere"}</option>
      ${cameras.map((ref) => html`<option key=${ref} value=${ref}>${nameOf(ref)}</option>`)}
    </select></label
  >`;
}

function useCameras(at) {
  const { store } = usePage();
  useTick(2000);
  return useRefs()
    .filter((ref) => ref !== at && new Offers(ref, store.get(ref, "capabilities")?.value).hasVideo)
    .sort();
}

// The live picture: how old it is, and the bar below it.

import * as browser from "../../core/browser.js";
import { Bands } from "../banner.js";
import { EXTRAS, PICTURE, SOUND_FACTS, VOICE } from "../cards/cards.js";
import { Boundary, html, useEffect, useLayoutEffect, useModel, usePage, useRef, useState, useTick, useValue } from "../parts/hooks.js";
import { read, write } from "../parts/models.js";
import { Button, Extra, Face, Icon, Part, useName } from "../parts/parts.js";
import { span } from "../parts/words.js";

/** Show pictures of ``source`` as long as this is on the page. @param {string} at @param {string} source "": none */
export function useVideo(at, source) {
  const { video, driver } = usePage();
  const [wanted, want] = useState(() => read(`video ${at}`, true) !== false);
  useEffect(() => {
    video.show(wanted ? source : "");
    driver.changed();
    return () => video.show("");
  }, [source, wanted]);
  return {
    wanted,
    toggle() {
      write(`video ${at}`, !wanted);
      want(!wanted);
    },
  };
}

/**
 * The picture with what must not be overlooked, and one bar below it. ``view``: of the cards, where the picture's
 * settings are one of them.
 */
export function Stage({ at, video: control, source, offers, view, layout }) {
  const { video } = usePage();
  useModel(video);
  useTick(200);
  const cover = useCover(control, source);
  const info = video.stream ? null : video.info;
  const name = useName(source);
  const { camera, camera_publisher: sender } = useValue(source, "media-status") ?? {};
  const problem = camera?.problem ?? sender?.problem;
  const over = html`${info &&
    html`<span class=${`tag tag-age ${cover || problem ? "bad" : ""}`} data-test="age">
      <${Age} video=${video} />${problem && html`<span data-test="picture-problem">· the camera ${problem.slice(0, 100)}</span>`}
    </span>`}
    ${source !== at && html`<span class="tag tag-from">seen from ${name}</span>`}
    <${Bands} at=${at} />`;
  return html`<${Frame} label="Live picture" alt=${`What ${name} sees`} part="Layer" source=${source} cover=${cover} face=${!info} over=${over}>
    ${layout !== "immersive" &&
    html`<${Bar} ...${{ at, control, source, offers, view }} short=${layout === "portrait"} wide=${layout === "desktop"} />`}
    ${layout === "immersive" &&
    html`<div class="float-tools">
      <${SnapshotButton} source=${source} />
      ${offers.has("audio") && html`<${Boundary} what="Sound"><${Part} part=${VOICE} lines=${0} at=${at} place="over" /><//>`}
    </div>`}
  <//>`;
}

/**
 * A picture, live or recorded. ``part``: of EXTRAS, what is drawn over it; ``cover``: why it is none of now; ``over``:
 * what else lies over it; ``children``: what is below it.
 * @param {any} props
 */
export function Frame({ label, alt, part, source, cover, face = false, over, children }) {
  const { video } = usePage();
  const place = useRef(null);
  useLayoutEffect(() => {
    const { current } = place;
    current.append(video.canvas);
    return () => {
      if (video.canvas.parentNode === current) video.canvas.remove(); // another layout may have it already
    };
  }, []);
  video.canvas.setAttribute("role", "img");
  video.canvas.setAttribute("aria-label", alt);
  return html`<section
    class=${`stage ${cover ? "stale" : ""} ${video.info ? "" : "blank"}`}
    aria-label=${label}
    data-card="picture"
    data-span="main"
  >
    <div class="picture">
      <div class="canvas" ref=${place}></div>
      <${Extra} of=${EXTRAS} part=${part} what="What is drawn over it" source=${source} />
      ${cover && html`<p class="cover" data-test="cover">${face && html`<${Face} at=${source} />`}${cover}</p>`}
      ${over}
    </div>
    ${children}
  </section>`;
}

/** One quiet line: what is done with picture and sound. What experts set is behind its last button. */
function Bar({ at, control, source, offers, view, short, wide }) {
  const [open, show] = useState(false);
  const { on, possible } = browser.fullScreen;
  const full = on ? "Leave full screen" : "Full screen";
  useEffect(() => {
    if (!open) return undefined;
    const end = (event) => event.key === "Escape" && show(false);
    addEventListener("keydown", end);
    return () => removeEventListener("keydown", end);
  }, [open]);
  return html`<div class="picture-bar" role="group" aria-label="Picture and sound">
      <${Button} test="video" icon=${control.wanted ? "pause" : "play"} onPress=${control.toggle}>
        <span>${control.wanted ? "Pause" : "Play"}</span>
      <//>
      <${Button}
        test="full-screen"
        label=${full}
        hidden=${!possible}
        icon=${on ? "small" : "full"}
        onPress=${() => browser.fullScreen.toggle()}
      >
        <span>${short ? "Full" : full}</span>
      <//>
      <${SnapshotButton} source=${source} short=${short} />
      ${offers.has("audio") &&
      html`<${Boundary} what="Sound"><${Part} part=${VOICE} lines=${0} at=${at} place=${short ? "short" : "bar"} /><//>`}
      <${Button}
        className="gear"
        test="gear"
        label="Settings of the picture"
        aria-expanded=${wide ? open : undefined}
        icon="gear"
        onPress=${() => (wide ? show(!open) : view?.reveal("picture"))}
      >
        ${short && html`<span>Picture</span>`}
      <//>
    </div>
    ${wide &&
    html`<section class="gear-panel" aria-label="Settings of the picture" data-test="gear-panel" hidden=${!open}>
      <div class="card-head">
        <h2>Picture</h2>
        <${Button} className="quiet" label="Close the settings of the picture" icon="close" onPress=${() => show(false)} />
      </div>
      ${offers.has("audio") && html`<${Part} part=${SOUND_FACTS} lines=${0} at=${at} />`}
      <${Part} part=${PICTURE} at=${at} source=${source} offers=${offers} video=${control} extras=${EXTRAS} />
    </section>`}`;
}

/** What takes the snapshot is fetched with the first one. */
export function SnapshotButton({ source, short = false }) {
  const { connection, store, video } = usePage();
  const off = !video.info || video.stream !== "";
  const why = off ? "There is no picture that could be saved" : undefined;
  const save = async () => {
    const { snapshot } = await import("./picture-extras.js");
    return `Saved as ${await snapshot(video, store, source)}`;
  };
  const press = () => save().then((text) => connection.show(text), (error) => connection.show(`Not saved: ${error.message}`));
  return html`<button type="button" data-test="snapshot" disabled=${off} title=${why} onClick=${press}>
    <${Icon} name="photo" /><span>${short ? "Photo" : "Snapshot"}</span>
  </button>`;
}

/** Why there is no live picture; "" there is. */
function useCover(control, source) {
  const { connection, video } = usePage();
  useModel(connection);
  const view = useValue(source, "web/picture");
  const online = useValue(source, "web/liveness")?.online;
  const name = useName(source);
  if (!control.wanted) return "Paused";
  if (video.stream) return "";
  const old = video.info ? ` · this picture is ${span(video.age().ms)} old` : "";
  if (!connection.isOpen) return `No connection to the server${old}`;
  if (video.info && !video.isStale) return "";
  if (view?.state === "held") return view.why + old;
  if (video.info && !video.hasStopped) return `The pictures come late${old}`;
  if (online === false) return `${name} is silent${old}`;
  if (view?.state === "refused") return `No picture: ${view.why || "the robot refuses"}`;
  if (video.info) return `The picture has stopped${old}`;
  if (video.state?.connection === "lost" && video.state.problem) return video.state.problem;
  if (view?.why) return view.why;
  return view?.state === "silent" ? "The camera sends nothing" : "Waiting for the first picture…";
}

const LIVE_MS = 500; // to this age people call a picture live

/** How old the picture is, if that matters. */
function Age({ video }) {
  const { ms, since } = video.age();
  if (ms >= LIVE_MS) return since === "taken" ? `${late(ms)} old` : `arrived ${late(ms)} ago`;
  return html`<i class="dot ok" aria-hidden="true"></i>${since === "taken" ? "live" : "just arrived"}`;
}

const late = (ms) => (ms < 10_000 ? `${(ms / 1000).toFixed(1)} s` : span(ms));

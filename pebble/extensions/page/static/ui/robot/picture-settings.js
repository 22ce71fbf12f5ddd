// How the pictures of a component come, and where from.

import { refusal } from "../../core/stream.js";
import { html, usePage, useRefs, useState, useTick, useValue } from "../parts/hooks.js";
import { Offers, write } from "../parts/models.js";
import { Button, Extra, Face, Select, Why, useEntered, useName } from "../parts/parts.js";
import { useReasons, whyNotEnd } from "../parts/why-not.js";
import { nameIn } from "../parts/looks.js";

/** Its source, which counts for everybody who looks at this component; and how the picture comes. */
export function PictureSettings({ at, source, offers, video, extras }) {
  const view = useValue(source, "web/picture");
  return html`<div class="picture-settings">
    <${PictureFrom} at=${at} source=${source} offers=${offers} />
    <${Extra} of=${extras} part="Tools" what="More of the picture" source=${source} wanted=${video?.wanted ?? true} />
    <${StreamAddress} key=${source} source=${source} />
    <${Facts} source=${source} view=${view} />
  </div>`;
}

/** For engineers: how the pictures come now. */
function Facts({ source, view }) {
  const { video } = usePage();
  useTick(1000);
  const { info, interval } = video;
  if (!info || video.ref !== source || video.stream) return null;
  const rate = view?.per_second > 0 ? view.per_second : interval > 0 ? 1000 / interval : 0;
  const facts = [
    `${info.encoding ?? ""}${info.rescue ? " (converted)" : ""} ${info.width}×${info.height}`,
    `${rate.toFixed(rate < 9.5 ? 1 : 0)}/s`,
    view?.kbits > 0 && `${Math.round(view.kbits)} kbit/s`,
    view?.viewers > 1 && `${view.viewers} viewers`,
  ];
  return html`<p class="facts" data-test="picture-facts">Now: ${facts.filter(Boolean).join(" · ")}</p>`;
}

/** For a component without a camera: another one may look at it, or a stream of any other program. */
export function NoCamera({ at, offers }) {
  const name = useName(at);
  return html`<section class="no-camera picture-settings" aria-label="Picture">
    <${Face} at=${at} />
    <p>${name} has no camera.</p>
    <${PictureFrom} at=${at} source=${at} offers=${offers} />
    <${StreamAddress} source=${at} />
  </section>`;
}

function PictureFrom({ at, source, offers }) {
  const page = useReasons(at);
  const { commands, store } = page;
  const why = whyNotEnd(page);
  const cameras = useCameras(at);
  const whyShown = why && html`<${Why} id="why-picture">${why}<//>`;
  if (!cameras.length) return whyShown;
  const none = ["", offers.hasVideo ? "Its own camera" : "Nowhere"];
  return html`<${Select}
      test="picture-from"
      title="Picture from"
      value=${source === at ? "" : source}
      choices=${[none, ...cameras.map((ref) => [ref, nameIn(store, ref)])]}
      why=${why}
      because="why-picture"
      onChoose=${(ref) => commands.setPictureFrom(at, ref)}
    />${whyShown}`;
}

/** Enter the address of a stream, for this browser: of a camera that is beside the robot, for example. */
function StreamAddress({ source }) {
  const { store } = usePage();
  const current = useEntered(source);
  const [typed, type] = useState(/** @type {string | null} */ (null)); // null: as it is
  const address = (typed ?? current).trim();
  const why = address && refusal(address, location);
  const set = (url) => {
    write(`stream ${source}`, url);
    store.set(source, "web/entered", url);
    type(null);
  };
  return html`<details class="stream-address">
    <summary data-test="stream-address">Stream from another address</summary>
    <form
      onSubmit=${(event) => {
        event.preventDefault();
        if (!why && address) set(address);
      }}
    >
      <label class="field"
        ><span>Address</span
        ><input
          type="text"
          inputmode="url"
          autocapitalize="off"
          spellcheck="false"
          placeholder="http://…"
          data-test="stream-url"
          value=${typed ?? current}
          aria-describedby=${why ? "why-stream-address" : undefined}
          onInput=${(event) => type(event.currentTarget.value)}
      /></label>
      <button data-test="set-stream" disabled=${Boolean(why) || !address || address === current}>Use it</button>
      ${current &&
      html`<${Button} test="unset-stream" onPress=${() => set("")}>Use it no more<//>`}
      ${why && html`<${Why} id="why-stream-address">${why}<//>`}
    </form>
  </details>`;
}

function useCameras(at) {
  const { store } = usePage();
  useTick(2000);
  return useRefs()
    .filter((ref) => ref !== at && new Offers(ref, store.get(ref, "capabilities")?.value).hasVideo)
    .sort();
}

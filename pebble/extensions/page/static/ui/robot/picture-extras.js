// What belongs to a picture besides it: what robots draw over it, snapshots, and the robot's own stream.

import * as browser from "../../core/browser.js";
import { MIXED, refusal } from "../../core/stream.js";
import { html, useEffect, useMetrics, useModel, usePage, useRef } from "../parts/hooks.js";
import { read, write } from "../parts/models.js";
import { Button, Check, Why, useName, useStream } from "../parts/parts.js";
import { NewestOverlays, STALE_MS, contained, drawOverlays } from "../../media/overlays.js";
import { nameOf, visible } from "../parts/words.js";

const OVERLAYS = "video-overlays";

/** Whether overlays are drawn over the pictures of a component; remembered in this browser. @param {string} ref */
function useOverlays(ref) {
  useModel(usePage().settings);
  return read(`overlays ${ref}`, true) !== false;
}

/** What lies over the picture of ``source``. */
export function Layer({ source }) {
  const { video, driver } = usePage();
  useModel(video);
  const address = useStream(source);
  const name = useName(source);
  const moved = video.stream !== "" && address !== "" && address !== video.stream;
  useEffect(() => {
    if (moved) show(video, driver, "");
  }, [moved]);
  return html`<${Drawn} source=${source} />
  ${video.stream &&
  html`<iframe
    class="stream"
    data-test="stream"
    title=${`The own stream of ${name}`}
    sandbox="allow-scripts allow-same-origin"
    referrerpolicy="no-referrer"
    src=${video.stream}
  ></iframe>`}`;
}

/** Overlays, if they are switched on. */
export const Drawn = ({ source }) => useOverlays(source) && html`<${Overlays} source=${source} />`;

function Overlays({ source }) {
  const { store, video } = usePage();
  const canvas = useRef(null);
  useEffect(() => {
    const own = canvas.current;
    if (!own) return undefined; // it was closed before it was shown
    const newest = new NewestOverlays();
    let timer = 0;
    const draw = () => {
      clearTimeout(timer);
      const overlays = newest.current(store.clock());
      paint(own, video.canvas, overlays);
      if (overlays.shapes.length || overlays.labels.length) timer = setTimeout(draw, STALE_MS / 5);
    };
    const take = () => {
      const entry = store.get(source, OVERLAYS);
      if (entry) newest.receive(entry.value, entry.receivedAt);
      draw();
    };
    const sizes = browser.sizes(draw);
    sizes.observe(video.canvas);
    const unsubscribe = store.subscribe(source, OVERLAYS, take);
    take(); // of a recording that is paused nothing follows
    return () => {
      unsubscribe();
      sizes.disconnect();
      clearTimeout(timer);
    };
  }, []);
  return html`<canvas class="overlays" ref=${canvas} aria-hidden="true" data-test="overlays-canvas"></canvas>`;
}

/** Draw over the picture exactly where it is: its canvas shows all of it in the middle of its box. */
function paint(canvas, picture, overlays) {
  const box = picture.getBoundingClientRect();
  const scale = devicePixelRatio || 1;
  const width = Math.round(box.width * scale);
  const height = Math.round(box.height * scale);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  const labels = overlays.labels.map((one) => ({ ...one, text: visible(one.text) }));
  drawOverlays(context, { ...overlays, labels }, contained(picture.width, picture.height, width, height), scale);
}

/** Among the settings of the picture of ``source``. ``wanted``: whether pictures are. */
export const Tools = ({ source, wanted }) => html`<${Marks} source=${source} />
  <${Stream} source=${source} wanted=${wanted} />`;

/** Whether what scripts mark is drawn over the picture. */
export function Marks({ source }) {
  const { settings } = usePage();
  const isOn = useOverlays(source);
  if (!useMetrics(source).includes(OVERLAYS)) return null;
  const set = (on) => {
    write(`overlays ${source}`, on);
    settings.changed();
  };
  return html`<${Check} className="overlay-switch" test="overlays" checked=${isOn} onChange=${set}>Marks of scripts<//>`;
}

/** Save what is on the canvas, under the time at which it was taken; returns the file's name. */
export async function snapshot(video, store, source) {
  if (!readsPixels()) throw new Error("this browser gives pages other pictures than they draw: allow it for this page");
  const name = fileName(source, store.now() - video.age().ms);
  const blob = await new Promise((resolve) => video.canvas.toBlob(resolve, "image/png"));
  if (!blob) throw new Error("this browser makes no PNG of it");
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  return name;
}

/** Whether what is drawn is read back as it was: browsers that resist fingerprinting give noise. */
function readsPixels() {
  const context = Object.assign(document.createElement("canvas"), { width: 8, height: 8 }).getContext("2d");
  context.fillStyle = "rgb(40 90 200)";
  context.fillRect(0, 0, 8, 8);
  return context.getImageData(0, 0, 8, 8).data.every((value, at) => Math.abs(value - [40, 90, 200, 255][at % 4]) < 9);
}

/** @param {string} source @param {number} ms epoch @returns {string} goob-2026-05-01T12-03-41.png, in local time */
export function fileName(source, ms) {
  const at = new Date(ms).toLocaleString("sv").replace(" ", "T").replaceAll(":", "-"); // Swedish dates are ISO 8601
  return `${nameOf(source).replace(/[^\w.-]/g, "_")}-${at}.png`;
}

/** Open the stream that the robot serves by itself, or that was entered for it, and what to know of it. */
function Stream({ source, wanted }) {
  const { video, driver } = usePage();
  const address = useStream(source);
  if (!address && !video.stream) return null;
  if (video.stream) {
    return html`<div class="stream-tools">
      <${Button} test="close-stream" icon="close" onPress=${() => show(video, driver, "")}>Close the stream<//>
      <p class="why">
        After a click on the stream, keys go to it: click beside it to drive. How old its picture is, is not known.
      </p>
    </div>`;
  }
  const refused = refusal(address, location);
  const why = refused || (wanted ? "" : "Start video first: the robot streams while video is wanted");
  return html`<div class="stream-tools">
    <${Button} test="open-stream" why=${why} because="why-stream" icon="play" onPress=${() => show(video, driver, address)}>
      Open the robot's own stream
    <//>
    ${why && html`<${Why} id="why-stream">${why}<//>`}
    ${refused === MIXED &&
    html`<a class="button" href=${address} target="_blank" rel="noopener noreferrer">Open it in another tab</a>`}
  </div>`;
}

/** The gesture ends: from now on it is not known how old the picture is. */
function show(video, driver, address) {
  driver.interrupt();
  video.stream = address;
  video.changed();
  driver.changed();
}

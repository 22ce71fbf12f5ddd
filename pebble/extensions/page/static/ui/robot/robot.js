// One component: its picture, how to drive it, and its cards; on a desktop, a phone, and a phone that lies.

import * as browser from "../../core/browser.js";
import { Bands } from "../banner.js";
import { AllButton } from "../header.js";
import { CARDS, DRIVE, EXTRAS, HUD, NO_CAMERA, PICTURE, TABS, VOICE, hasMap } from "../cards/cards.js";
import { useColumns } from "./columns.js";
import { DriveCard, DrivePad, Slot, Speed } from "./drive.js";
import {
  Boundary, fetchRest, html, useEffect, useMemo, useMetric, useMetrics, useModel, usePage, usePart, useState, useTick, useValue,
} from "../parts/hooks.js";
import { CardView, Offers, WATCHES } from "../parts/models.js";
import { hasFace } from "../parts/looks.js";
import { Button, Card, Face, Icon, Part, useName, useStream } from "../parts/parts.js";
import { Stage, useVideo } from "./video.js";
import { typeOf } from "../parts/words.js";

/** ``stage``: what shows the picture; ``watches``: without cards that only send. */
export function Robot({ at, layout, drawer, onPanel, stage = Stage, watches }) {
  const offers = new Offers(at, useValue(at, "capabilities"), useMetrics(at));
  const view = useMemo(() => new CardView(at), [at]);
  useModel(view);
  const source = useValue(at, "web/picture-from")?.source || at;
  const stream = useStream(at);
  const hasVideo = offers.hasVideo || source !== at || stream !== "";
  const known = useKnown(at);
  const video = useVideo(at, hasVideo && known ? source : "");
  const online = useValue(source, "web/liveness")?.online !== false;
  const awaits = !known || (hasVideo && video.wanted && online);
  useEffect(() => {
    if (!awaits) fetchRest();
  }, [awaits]);
  const parts = { at, offers, view, video: hasVideo ? video : null, source, stage, watches };
  if (!known) return html`<${Unknown} at=${at} layout=${layout} />`;
  if (layout === "immersive") return html`<${Immersive} ...${parts} drawer=${drawer} onPanel=${onPanel} />`;
  if (layout === "portrait") return html`<${Portrait} ...${parts} onPanel=${onPanel} />`;
  return html`<${Desktop} ...${parts} />`;
}

/** Whether anything was received of it; the answer takes a moment after a reload. */
function useKnown(at) {
  const { store } = usePage();
  const liveness = useMetric(at, "web/liveness");
  return Boolean(liveness) || store.metrics(at).some((metric) => !metric.startsWith("web/"));
}

/** While the page connects it has the shape of most robots' pages. */
function Unknown({ at, layout }) {
  const { connection } = usePage();
  useModel(connection);
  useTick(500); // the first state may have nothing of it
  const name = useName(at);
  const isOpen = connection.isOpen && !connection.socket.outdated;
  if (isOpen || !hasFace(at)) {
    const text = isOpen ? `Nothing was received from ${at} yet.` : "Connecting to the server…";
    return html`<div class="empty"><${Icon} name="robot" /><h1 class="sr">${name}</h1><p>${text}</p></div>`;
  }
  const isWhole = layout === "immersive";
  return html`<div class="robot" aria-busy="true">
    <h1 class="sr">${name}</h1>
    <div class=${layout === "desktop" ? "bench connecting" : isWhole ? "" : "phone-drive"}>
      <div class="stage" data-span="main">
        <div class="picture">
          <div class="canvas"><canvas width="640" height="360" aria-hidden="true"></canvas></div>
          <p class="cover"><${Face} at=${at} />Connecting to the server…</p>
          <${Bands} at=${at} />
        </div>
        ${!isWhole && html`<div class="picture-bar"></div>`}
      </div>
      ${layout === "desktop"
        ? html`<${DriveCard} at=${at} />`
        : isWhole
          ? html`<${Floating} at=${at} />`
          : html`<section class="phone-pad" aria-label="Drive"><${Slot} at=${at} /><${DrivePad} /><${Speed} /></section>`}
    </div>
  </div>`;
}

function Desktop({ at, offers, view, video, source, stage, watches }) {
  const cards = wanted(offers, view, watches).filter(({ part }) => part !== VOICE || !video);
  const usual = cards.filter(({ engineers }) => !engineers);
  const side = !offers.drives && video ? usual[0] : null;
  const shown = (card) => html`<${CardOf} key=${card.id} card=${card} ...${{ at, offers, view }} side=${card === side} />`;
  const grid = useColumns();
  return html`<div class="robot">
    <h1 class="sr">${useName(at)}</h1>
    ${!video && !offers.drives && html`<${Bands} at=${at} />`}
    <div class="bench" ref=${grid}>
      ${video &&
      html`<${Boundary} what="The picture"
        ><${stage} at=${at} video=${video} source=${source} offers=${offers} layout="desktop"
      /><//>`}
      ${!video && offers.drives && html`<${NoPicture} at=${at} offers=${offers} />`}
      ${offers.drives && html`<${Boundary} vital what="Driving"><${DriveCard} at=${at} offers=${offers} /><//>`}
      ${usual.map(shown)}
      <section class="engineers" data-span="all" data-card="engineers" aria-labelledby="engineers-title">
        <${Missing} at=${at} offers=${offers} view=${view} hasVideo=${Boolean(video)} />
        <h2 id="engineers-title">For engineers</h2>
        <div class="engineers-cards">${cards.filter(isEngineers).map(shown)}</div>
      </section>
    </div>
  </div>`;
}

const isEngineers = ({ engineers = false }) => engineers;

/** In place of a picture: that there is none, how it looks, and what must not be overlooked. */
const NoPicture = ({ at, offers }) => html`<div class="stage no-picture" data-span="main" data-card="picture">
  <${Bands} at=${at} />
  <${Part} part=${NO_CAMERA} lines=${1} at=${at} offers=${offers} />
</div>`;

function Portrait({ at, offers, view, video, source, stage, watches, onPanel }) {
  const [chosen, choose] = useState("");
  const cards = wanted(offers, view, watches);
  const first = Boolean(video) || offers.drives;
  const tabOf = (card) => {
    if (first && !offers.drives && card.tab === "sensors") return "drive";
    return first || typeOf(at) === "robots" ? card.tab : "sensors"; // little is known of it: all of that in one place
  };
  const has = (id) => (id === "drive" ? first : id === "more" || cards.some((card) => tabOf(card) === id));
  const tabs = TABS.filter(({ id }) => has(id));
  const tab = tabs.some(({ id }) => id === chosen) ? chosen : tabs[0].id;
  useEffect(() => {
    const card = cards.find(({ id }) => id === view.wanted);
    if (card) choose(tabOf(card));
    else if (view.wanted === "picture") choose("more");
  }, [view.wanted]);
  const here = cards.filter((card) => tabOf(card) === tab);
  const usual = here.filter((card) => !card.engineers);
  const engineers = here.filter(isEngineers);
  const shown = (card) => html`<${CardOf} key=${card.id} card=${card} ...${{ at, offers, view }} />`;
  return html`<div class="robot">
    <h1 class="sr">${useName(at)}</h1>
    ${tab === "drive" &&
    html`<div class="phone-drive">
      ${video
        ? html`<${Boundary} what="The picture"
            ><${stage} at=${at} video=${video} source=${source} offers=${offers} view=${view} layout="portrait"
          /><//>`
        : html`<${NoPicture} at=${at} offers=${offers} />`}
      ${offers.drives &&
      html`<${Boundary} vital what="Driving">
        <section class="phone-pad" aria-label="Drive">
          <${Slot} at=${at} />
          <${DrivePad} />
          <${Speed} />
          ${video
            ? html`<details class="folded">
                <summary data-test="more-drive">Turn, balance${offers.hasExtraAxis && ", extra axis"}</summary>
                <${Part} part=${DRIVE} open />
              </details>`
            : html`<${Part} part=${DRIVE} open />`}
        </section>
      <//>`}
    </div>`}
    ${tab !== "drive" && html`<${Bands} at=${at} />`}
    <div class="cards">
      ${usual.map(shown)}
      ${tab === "more" &&
      video &&
      html`<${PictureCard} ...${{ at, source, offers, video }} />`}
      ${tab !== "more" && html`<${Hidden} cards=${hidden(view).filter((card) => tabOf(card) === tab)} view=${view} />`}
      ${engineers.length > 0 && html`<h2 class="engineers-head">For engineers</h2>`} ${engineers.map(shown)}
      ${tab === "more" &&
      html`<${Missing} at=${at} offers=${offers} view=${view} hasVideo=${Boolean(video)} />
        <${MoreSettings} onPanel=${onPanel} />`}
    </div>
    <nav class="tabs" aria-label="Parts of this page">
      ${tabs.map(
        ({ id, title, icon }) => html`<${Button}
          key=${id}
          test=${`tab-${id}`}
          aria-current=${id === tab ? "page" : undefined}
          icon=${id === "drive" && !offers.drives ? "camera" : icon}
          onPress=${() => choose(id)}
        >
          <span>${id === "drive" && !offers.drives ? "Picture" : title}</span>
        <//>`,
      )}
    </nav>
  </div>`;
}

function Immersive({ at, offers, view, video, source, drawer, onPanel }) {
  const cards = wanted(offers, view);
  return html`<div class="robot">
    <h1 class="sr">${useName(at)}</h1>
    ${video
      ? html`<${Boundary} what="The picture"
          ><${Stage} at=${at} video=${video} source=${source} offers=${offers} layout="immersive"
        /><//>`
      : html`<div class="stage"><div class="picture"><p class="cover"><${Face} at=${at} />No camera</p><${Bands} at=${at} /></div></div>`}
    <${Extras} at=${at} offers=${offers} />
    ${offers.drives &&
    html`<${Boundary} vital what="Driving"><${Floating} at=${at} /><//>`}
    ${drawer &&
    html`<aside class="drawer" aria-label="Everything else">
      ${offers.drives &&
      html`<${Card} id="drive-settings" title="Driving" icon="wheel"><${Speed} /><${Part} part=${DRIVE} open /><//>`}
      ${video && html`<${PictureCard} ...${{ at, source, offers, video }} />`}
      ${cards.map((card) => html`<${CardOf} key=${card.id} card=${card} ...${{ at, offers, view }} />`)}
      <${MoreSettings} onPanel=${onPanel} />
    </aside>`}
  </div>`;
}

/** Its settings, where no gear opens them. */
const PictureCard = (props) => html`<${Card} id="picture" title="Picture" icon="camera"><${Part} part=${PICTURE} ...${props} extras=${EXTRAS} /><//>`;

/** What drives, over a picture that is the whole page. */
const Floating = ({ at }) => html`<div class="float-pad"><${DrivePad} /></div>
  <div class="float-why"><${Slot} at=${at} /></div>`;

/** Over a picture that is the whole page: how fast, how full, and where. They come later, and take no place. */
function Extras({ at, offers }) {
  const { body } = usePart(HUD);
  return (
    body &&
    html`<${Boundary} what="What lies over the picture"><${body} at=${at} offers=${offers} map=${hasMap(offers)} /><//>`
  );
}

const MoreSettings = ({ onPanel }) => html`<${Button} className="wide" test="settings" icon="settings" onPress=${onPanel}>
  <${SettingsWords} />
<//>
  ${browser.fullScreen.on &&
  html`<${Button} className="wide" icon="small" onPress=${() => browser.fullScreen.toggle()}>Leave full screen<//>`}
  <div class="stop-all-place"><${AllButton} outlined /></div>`;

function SettingsWords() {
  const { unread } = useModel(usePage().connection, (one) => one.unread);
  return `Settings and notices${unread ? ` (${unread} new)` : ""}`;
}

const wanted = (offers, view, watches = WATCHES) =>
  CARDS.filter((card) => card.wants(offers) && !view.hidden.has(card.id) && !(watches && card.sends));

/** Until its part is here the height that it usually has is kept free. */
function CardOf({ card, at, offers, view, side = false }) {
  const { body, failed } = usePart(card.part);
  return html`<${Card}
    id=${card.id}
    title=${card.title}
    icon=${card.icon}
    view=${view}
    isFirst=${isEngineers(card)}
    className=${isEngineers(card) ? "of-engineers" : ""}
    place=${side
      ? { "data-at": "side" }
      : { "data-height": card.height, "data-side-height": card.sideHeight, "data-wide": card.wide ? "" : undefined }}
    style=${body || failed || !card.height ? undefined : { minHeight: `${card.height}px` }}
  >
    <${Boundary} what=${card.title}><${Part} part=${card.part} lines=${5} at=${at} offers=${offers} view=${view} /><//>
  <//>`;
}

/** What is not on this page, and why. */
function Missing({ at, offers, view, hasVideo }) {
  const isRobot = typeOf(at) === "robots";
  const name = useName(at);
  const lacks = [!hasVideo && "camera", !offers.drives && offers.known && "driving"].filter((one) => isRobot && one);
  return html`${lacks.length > 0 && html`<p class="dim">Not on ${name}: ${lacks.join(", ")}.</p>`}
    <${Hidden} cards=${hidden(view)} view=${view} />`;
}

const hidden = (view) => CARDS.filter((card) => view.hidden.has(card.id));

/** What was hidden comes back by these. */
function Hidden({ cards, view }) {
  if (!cards.length) return null;
  return html`<div class="missing">
    ${cards.map(
      ({ id, title }) => html`<${Button} key=${id} onPress=${() => view.show(id)}>Show ${title}<//>`,
    )}
  </div>`;
}

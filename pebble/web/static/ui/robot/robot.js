// One component: its picture, how to drive it, and its cards; on a desktop, a phone, and a phone that lies.

import * as browser from "../../core/browser.js";
import { CARDS, DRIVE, EXTRAS, NO_CAMERA, PICTURE, TABS, VOICE } from "../cards/cards.js";
import { DriveCard, DrivePad, Speed, WhyLine } from "./drive.js";
import { Boundary, fetchRest, html, useEffect, useMetric, useMetrics, useModel, usePage, useState, useValue } from "../parts/hooks.js";
import { CardView, Offers, WATCHES } from "../parts/models.js";
import { Card, Icon, Part, useStream } from "../parts/parts.js";
import { Stage, useVideo } from "./video.js";
import { nameOf, typeOf } from "../parts/words.js";

export function Robot({ at, layout, drawer, onPanel }) {
  const offers = new Offers(at, useValue(at, "capabilities"), useMetrics(at));
  const [view] = useState(() => new CardView(at));
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
  const parts = { at, offers, view, video: hasVideo ? video : null, source };
  if (!known) return html`<${Unknown} at=${at} />`;
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

function Unknown({ at }) {
  const { connection } = usePage();
  useModel(connection);
  const text = connection.isOpen ? `Nothing was received from ${at} yet.` : "Connecting to the server…";
  return html`<div class="empty"><${Icon} name="robot" /><h1 class="sr">${nameOf(at)}</h1><p>${text}</p></div>`;
}

function Desktop({ at, offers, view, video, source }) {
  const cards = wanted(offers, view).filter(({ part }) => part !== VOICE || !video);
  const side = !offers.drives && video ? cards.shift() : null;
  const shown = (card) => html`<${CardOf} key=${card.id} card=${card} at=${at} offers=${offers} view=${view} />`;
  return html`<div class="robot">
    <h1 class="sr">${nameOf(at)}</h1>
    <div class=${`bench ${offers.drives || side ? "" : "no-side"}`}>
      <div class="bench-main">
        ${video &&
        html`<${Boundary} what="The picture"
          ><${Stage} at=${at} video=${video} source=${source} offers=${offers} wide
        /><//>`}
        ${!video && offers.drives && html`<${Part} part=${NO_CAMERA} at=${at} offers=${offers} />`}
        <div class="cards">
          ${columns(cards).map((column, index) => html`<div key=${index} class="column">${column.map(shown)}</div>`)}
        </div>
        ${cards.filter(({ wide }) => wide).map(shown)}
        <${Missing} at=${at} offers=${offers} view=${view} hasVideo=${Boolean(video)} />
      </div>
      ${offers.drives && html`<${Boundary} vital what="Driving"><${DriveCard} at=${at} offers=${offers} /><//>`}
      ${side && html`<${CardOf} card=${side} at=${at} offers=${offers} view=${view} />`}
    </div>
  </div>`;
}

function Portrait({ at, offers, view, video, source, onPanel }) {
  const [chosen, choose] = useState("");
  const cards = wanted(offers, view);
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
  }, [view.wanted]);
  return html`<div class="robot">
    <h1 class="sr">${nameOf(at)}</h1>
    ${tab === "drive" &&
    html`<div class="phone-drive">
      ${video &&
      html`<${Boundary} what="The picture"><${Stage} at=${at} video=${video} source=${source} offers=${offers} /><//>`}
      ${!video && offers.drives && html`<${Part} part=${NO_CAMERA} at=${at} offers=${offers} />`}
      ${offers.drives &&
      html`<${Boundary} vital what="Driving">
        <section class="phone-pad" aria-label="Drive">
          <${WhyLine} at=${at} />
          <${DrivePad} />
          <${Speed} />
          <details class="more-drive" open=${!video}>
            <summary data-test="more-drive">Turn, balance, extra axis</summary>
            <${Part} part=${DRIVE} />
          </details>
        </section>
      <//>`}
    </div>`}
    <div class="cards">
      ${cards
        .filter((card) => tabOf(card) === tab)
        .map((card) => html`<${CardOf} key=${card.id} card=${card} at=${at} offers=${offers} view=${view} />`)}
      ${tab !== "more" && html`<${Hidden} cards=${hidden(view).filter((card) => tabOf(card) === tab)} view=${view} />`}
      ${tab === "more" &&
      html`${video &&
        html`<${Card} id="picture" title="Picture" icon="camera"
          ><${Part} part=${PICTURE} at=${at} source=${source} offers=${offers}
        /><//>`}
        <${Missing} at=${at} offers=${offers} view=${view} hasVideo=${Boolean(video)} />
        <${MoreSettings} onPanel=${onPanel} />`}
    </div>
    <nav class="tabs" aria-label="Parts of this page">
      ${tabs.map(
        ({ id, title, icon }) => html`<button
          key=${id}
          type="button"
          data-test=${`tab-${id}`}
          aria-current=${id === tab ? "page" : undefined}
          onClick=${() => choose(id)}
        >
          <${Icon} name=${id === "drive" && !offers.drives ? "camera" : icon} />
          <span>${id === "drive" && !offers.drives ? "Picture" : title}</span>
        </button>`,
      )}
    </nav>
  </div>`;
}

function Immersive({ at, offers, view, video, source, drawer, onPanel }) {
  const cards = wanted(offers, view);
  return html`<div class="robot">
    <h1 class="sr">${nameOf(at)}</h1>
    ${video
      ? html`<${Boundary} what="The picture"
          ><${Stage} at=${at} video=${video} source=${source} offers=${offers} immersive
        /><//>`
      : html`<div class="stage"><p class="cover">no camera</p></div>`}
    ${offers.drives &&
    html`<${Boundary} vital what="Driving">
      <div class="float-pad"><${DrivePad} /></div>
      <div class="float-why"><${WhyLine} at=${at} /></div>
    <//>`}
    ${drawer &&
    html`<aside class="drawer" aria-label="Everything else">
      ${offers.drives &&
      html`<${Card} id="drive-settings" title="Driving" icon="wheel"><${Speed} /><${Part} part=${DRIVE} /><//>`}
      ${video &&
      html`<${Card} id="picture" title="Picture" icon="camera"
        ><${Part} part=${PICTURE} at=${at} source=${source} offers=${offers} video=${video} extras=${EXTRAS}
      /><//>`}
      ${cards.map((card) => html`<${CardOf} key=${card.id} card=${card} at=${at} offers=${offers} view=${view} />`)}
      <${MoreSettings} onPanel=${onPanel} />
    </aside>`}
  </div>`;
}

const MoreSettings = ({ onPanel }) => html`<button type="button" class="wide" data-test="settings" onClick=${onPanel}>
    <${Icon} name="settings" /><${SettingsWords} />
  </button>
  ${browser.fullScreen.on &&
  html`<button type="button" class="wide" onClick=${() => browser.fullScreen.toggle()}>
    <${Icon} name="small" />Leave full screen
  </button>`}`;

function SettingsWords() {
  const { unread } = useModel(usePage().connection, (one) => one.unread);
  return `Settings and notices${unread ? ` (${unread} new)` : ""}`;
}

const wanted = (offers, view) =>
  CARDS.filter((card) => card.wants(offers) && !view.hidden.has(card.id) && !(WATCHES && card.sends));

/** Two columns, so that a card that grows moves only those below it. */
function columns(cards) {
  const narrow = cards.filter(({ wide }) => !wide);
  const [left, right] = [false, true].map((wanted) => narrow.filter(({ right: is = false }) => is === wanted));
  if (!right.length) right.push(...left.splice(Math.ceil(left.length / 2)));
  return [left, right].filter((column) => column.length);
}

function CardOf({ card, at, offers, view }) {
  return html`<${Card} id=${card.id} title=${card.title} icon=${card.icon} view=${view}>
    <${Boundary} what=${card.title}><${Part} part=${card.part} at=${at} offers=${offers} view=${view} /><//>
  <//>`;
}

/** What is not on this page, and why. */
function Missing({ at, offers, view, hasVideo }) {
  const isRobot = typeOf(at) === "robots";
  const lacks = [!hasVideo && "camera", !offers.drives && offers.known && "driving"].filter((one) => isRobot && one);
  return html`${lacks.length > 0 && html`<p class="dim">Not on ${nameOf(at)}: ${lacks.join(", ")}.</p>`}
    <${Hidden} cards=${hidden(view)} view=${view} />`;
}

const hidden = (view) => CARDS.filter((card) => view.hidden.has(card.id));

/** What was closed comes back by these. */
function Hidden({ cards, view }) {
  if (!cards.length) return null;
  return html`<div class="missing">
    ${cards.map(
      ({ id, title }) => html`<button key=${id} type="button" onClick=${() => view.show(id)}>Show ${title}</button>`,
    )}
  </div>`;
}

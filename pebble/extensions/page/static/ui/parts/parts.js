// Small parts of many widgets.

import * as browser from "../../core/browser.js";
import { drivesItself, inWords, scriptName } from "../../core/reasons.js";
import { Boundary, html, useEffect, useLater, useOnline, usePage, usePart, useRecent, useRef, useState, useTick, useValue } from "./hooks.js";
import { Route, read } from "./models.js";
import { chargeWords, drawing, hasFace, looksOf } from "./looks.js";
import { reported, roughly } from "./words.js";

const ICONS = new URL("../../icons.svg", import.meta.url).href;
const GONE_MS = 10_000;
const LATE_MS = 250; // beyond two periods

/** @param {{name: string}} props */
export const Icon = ({ name }) => html`<svg class="icon" aria-hidden="true"><use href=${`${ICONS}#${name}`} /></svg>`;

/**
 * A button. ``why`` it is off now; "" it is not. ``because``: the id of where that is said.
 * @param {any} props
 */
export const Button = ({ test, className, label, why = "", because = `why-${test}`, icon, onPress, children, ...more }) => html`<button
  type="button"
  class=${className}
  data-test=${test}
  aria-label=${label}
  aria-describedby=${why ? because : undefined}
  disabled=${Boolean(why)}
  onClick=${onPress}
  ...${more}
>
  ${icon && html`<${Icon} name=${icon} />`}${children}
</button>`;

/** A box to tick; ``why`` it is off now. @param {any} props */
export const Check = ({ test, className = "", checked, why = "", onChange, children, ...more }) => html`<label class=${`check ${className}`}
  ><input
    type="checkbox"
    data-test=${test}
    checked=${checked}
    disabled=${Boolean(why)}
    onChange=${(event) => onChange(event.currentTarget.checked)}
    ...${more}
  /><span>${children}</span></label
>`;

/**
 * A list to choose from. ``choices``: values and words. ``title``: beside it; ``label``: where there is none. The rest is as of Button.
 * @param {any} props
 */
export function Select({ test, title, label, value, choices, why = "", because, onChoose }) {
  const list = html`<select
    data-test=${test}
    aria-label=${label}
    aria-describedby=${why ? because : undefined}
    disabled=${Boolean(why)}
    value=${value}
    onChange=${(event) => onChoose(event.currentTarget.value)}
  >
    ${choices.map(([one, words]) => html`<option key=${one} value=${one}>${words}</option>`)}
  </select>`;
  return title ? html`<label class="field"><span>${title}</span>${list}</label>` : list;
}

/** A button that stops at the first touch, not when the finger is lifted, and with any finger. */
export function StopButton({ onStop, label, children, className = "", describedBy, test }) {
  const touchedAt = useRef(-Infinity);
  return html`<span class="stop-area">
    <button
      type="button"
      class=${`stop ${className}`}
      data-test=${test}
      aria-label=${label}
      aria-describedby=${describedBy}
      onPointerDown=${() => {
        touchedAt.current = performance.now();
        onStop();
      }}
      onClick=${(event) => (event.detail === 0 || performance.now() - touchedAt.current > 1500) && onStop()}
      onContextMenu=${(event) => event.preventDefault()}
    >
      ${children}
    </button>
  </span>`;
}

const isPress = ({ code, repeat }) => (code === "Space" || code === "Enter") && !repeat;

/**
 * Attributes of what works while a pointer holds it, wherever that goes; and, with ``keys``, while a key does.
 * @param {(event: any) => void} begin @param {() => void} end @param {boolean} [keys]
 */
export const held = (begin, end, keys = false) => ({
  onPointerDown(event) {
    if (event.button) return;
    browser.capture(event);
    begin(event);
  },
  onPointerUp: end,
  onPointerCancel: end,
  onLostPointerCapture: end,
  onContextMenu: (event) => event.preventDefault(), // a finger that stays
  ...(keys && { onBlur: end, onKeyDown: (event) => isPress(event) && begin(event), onKeyUp: end }),
});

const HOLD_MS = 1000;
const HINT_MS = 2500;

/** A button that has to be held for a second, by pointer or key. */
export function HoldButton({ onHeld, disabled = false, children, className = "", describedBy, test }) {
  const [holds, hold] = useState(false);
  const [tappedAt, tap] = useState(-Infinity);
  const tapped = useRecent(tappedAt, HINT_MS);
  const done = useRef(onHeld);
  done.current = disabled ? () => {} : onHeld;
  useEffect(() => {
    if (disabled) hold(false); // the end of a press on a button that is off is not reported
    if (!holds || disabled) return undefined;
    const timer = setTimeout(() => {
      hold(false);
      done.current();
    }, HOLD_MS);
    return () => clearTimeout(timer);
  }, [holds, disabled]);
  const end = () => {
    if (holds) tap(performance.now()); // too early
    hold(false);
  };
  const begin = () => {
    tap(-Infinity);
    hold(true);
  };
  return html`<button
    type="button"
    class=${`hold ${holds ? "held" : ""} ${className}`}
    data-test=${test}
    disabled=${disabled}
    aria-describedby=${describedBy}
    ...${held(begin, end, true)}
    onContextMenu=${(event) => {
      event.preventDefault();
      end();
    }}
  >
    <span class="hold-fill" aria-hidden="true"></span><span class="hold-text"
      >${tapped && !holds ? "Keep it pressed for 1 s" : children}</span
    >
  </button>`;
}

/** The reason under a control that is off. */
export const Why = ({ id, children }) => html`<span class="why" id=${id}>${children}</span>`;

/** What is no longer shown as a value. */
export const Gone = ({ age, children }) => html`<span class="dim">– <small>(${roughly(age)} ago: ${children})</small></span>`;

/** Whether it is too old to be shown as a value. @param {{age: number, period: number}} entry @param {boolean} online */
export const isGone = ({ age, period }, online) => !online || (period > 0 && age > Math.max(GONE_MS, 3 * period));

/**
 * A value and how old it is: of another colour after two periods; after ten seconds, or three periods if these are
 * longer, or at once if its source has ``ended``, it is no longer shown as a value. ``usual``: ms of a period, until it
 * is known.
 * @param {{entry?: import("../../core/store.js").Value, online?: boolean, ended?: boolean, usual?: number, children: any}} props
 */
export function Live({ entry, online = true, ended = false, usual = 0, children }) {
  const { age = 0, period: known = 0 } = entry ?? {};
  const period = known || usual;
  const lateAt = period > 0 ? 2 * period + LATE_MS : Infinity;
  const late = age > lateAt;
  useTick(!online || late ? 1000 : 0); // its age is shown
  useLater(online && !late ? lateAt - age + 1 : Infinity);
  if (!entry) return html`<span class="dim">–</span>`;
  if (isGone({ age, period }, online) || (late && ended)) return html`<${Gone} age=${age}>${children}<//>`;
  return html`<span class=${late ? "late" : ""}>${children}${late && age >= 1000 && html` <small>${roughly(age)} old</small>`}</span>`;
}

/**
 * ``isFirst``: it is closed until it is opened. ``place``: attributes that say where it is in the columns.
 * @param {{title: string, id: string, icon?: string, aside?: any, view?: any, isFirst?: boolean,
 *   className?: string, place?: Record<string, string>, style?: any, children: any}} props
 */
export function Card({ title, id, icon, aside, view, isFirst = false, className = "", place, style, children }) {
  const closed = view?.isClosed(id, isFirst) ?? false;
  return html`<section
    class=${`card ${closed ? "closed" : ""} ${className}`}
    aria-labelledby=${`${id}-title`}
    data-card=${id}
    style=${closed ? undefined : style}
    ...${place}
  >
    <header class="card-head">
      ${icon && html`<${Icon} name=${icon} />`}
      <h2 id=${`${id}-title`}>${title}</h2>
      ${aside}
      ${view &&
      html`<${Button} className="quiet" test=${`hide-${id}`} label=${`Hide ${title}`} icon="close" onPress=${() => view.hide(id)} />
      <${Button}
        className="quiet"
        label=${`${closed ? "Open" : "Close"} ${title}`}
        aria-expanded=${!closed}
        icon=${closed ? "down" : "up"}
        onPress=${() => view.toggle(id, isFirst)}
      />`}
    </header>
    ${!closed && html`<div class="card-body">${children}</div>`}
  </section>`;
}

/**
 * A list below a button, closed by Escape and when the focus leaves it. It takes the focus itself: else a press on the
 * words of a label would give it to the whole page.
 * @param {any} props
 */
export function Drop({ summary, test, look = "", className = "", children }) {
  const place = useRef(/** @type {HTMLDetailsElement | null} */ (null));
  const close = () => (place.current.open = false);
  useEffect(() => {
    const end = (event) => event.key === "Escape" && close();
    addEventListener("keydown", end);
    return () => removeEventListener("keydown", end);
  }, []);
  return html`<details
    class=${`drop ${className}`}
    ref=${place}
    onFocusOut=${(event) => event.relatedTarget && !event.currentTarget.contains(event.relatedTarget) && close()}
  >
    <summary class=${look} data-test=${test}>${summary}</summary>
    <div class="drop-list" tabindex="-1">${children}</div>
  </details>`;
}

/** A part of the page that is fetched when it is first shown; ``now``: even before the first picture. */
export function Part({ part, now = false, lines = 3, ...props }) {
  const { body, failed } = usePart(part, now);
  if (body) return html`<${body} ...${props} />`;
  if (!failed) return html`<${Skeleton} lines=${lines} />`;
  return html`<p class="failed" role="alert">
    A part of this page could not be fetched.
    <${Button} onPress=${() => location.reload()}>Try again<//>
  </p>`;
}

/** The shape of what will be here; it says so in words only after a while. */
export const Skeleton = ({ lines }) => html`<div class="loading" role="status">
  ${Array.from({ length: lines }, (_, line) => html`<i key=${line} class="bone" aria-hidden="true"></i>`)}
  <span class="loading-words">Loading…</span>
</div>`;

/**
 * One of the components that ``of`` fetches: nothing until it is here, and it may fail without what it is beside.
 * @param {any} props
 */
export function Extra({ of, part, what, source, ...props }) {
  const { body } = usePart(of);
  return body && html`<${Boundary} key=${source} what=${what}><${body[part]} source=${source} ...${props} /><//>`;
}

/** The stream that was entered for it in this browser; "" none. @param {string} at @returns {string} */
export const useEntered = (at) => useValue(at, "web/entered") ?? read(`stream ${at}`, "");

/** The address of its own stream: what was entered, else what it reports; "" none. @param {string} at */
export function useStream(at) {
  const own = reported(useValue(at, "status"));
  return useEntered(at) || own;
}

/** That it drives itself, in the server's words; "" a person drives, or nobody. @param {string} at @returns {string} */
export function useItself(at) {
  const { words } = usePage().connection;
  const status = useValue(at, "autonomy-status");
  const name = useName(at);
  const stopped = useValue(at, "web/estop")?.latched;
  if (!useOnline(at) || stopped || !drivesItself(status)) return "";
  return inWords(words, "itself", { name, script: scriptName(status) });
}

/**
 * The script that publishes a metric of this robot, if it does not run.
 * @param {string} at @param {string} metric @returns {{file: string, label?: string} | undefined}
 */
export function useEnded(at, metric) {
  const script = useValue(at, "autonomy-files")?.files?.find(({ file }) => file === metric);
  const status = useValue(at, "autonomy-status");
  const all = status ? [status, ...(status.dependencies ?? [])] : [];
  return all.some(({ file, running }) => running && file === metric) ? undefined : status && script;
}

/** What people call it. @param {string} at @returns {string} */
export const useName = (at) => looksOf(at, useValue(at, "capabilities")).name;

/**
 * In percent where its cells are known. ``level``: its entry. ``digits``: of volts
 * @param {{at: string, level: any, online: boolean, digits?: number}} props
 */
export function Charge({ at, level, online, digits = 2 }) {
  const { cells } = looksOf(at, useValue(at, "capabilities"));
  return html`<${Live} entry=${level} online=${online}>${chargeWords(level.value, cells, digits)}<//>`;
}

/** The drawing of a robot, in its colour; nothing of a component that is none. @param {{at: string}} props */
export function Face({ at }) {
  const { picture, colour } = looksOf(at, useValue(at, "capabilities"));
  if (!hasFace(at)) return null;
  return html`<span class=${`face tint-${colour}`}><${Drawing} picture=${picture} /></span>`;
}

/** @param {{picture: string}} props one of looks.js */
export const Drawing = ({ picture }) => html`<svg class="drawing" viewBox="0 0 48 48" aria-hidden="true"
  ><use href=${drawing(picture)} /></svg
>`;

/** Follow a link to a component, or the fleet, without loading the page again. @param {any} props */
export function RouteLink({ to = "", path = Route.path(to), className, label, children }) {
  const { route } = usePage();
  const go = (event) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey || event.button) return;
    event.preventDefault();
    route.open(path);
  };
  return html`<a class=${className} href=${path} aria-label=${label} onClick=${go}>${children}</a>`;
}

/** Move one of the driver's sliders. */
export function set(driver, name) {
  return (event) => {
    driver.sliders[name] = Number(event.currentTarget.value) / 100;
    driver.changed();
  };
}

export function Slider({ name, value, min, max = 100, text, onInput }) {
  return html`<label class="slider">
    <span>${name}</span>
    <input
      type="range"
      data-test=${name.toLowerCase()}
      min=${min}
      max=${max}
      step="5"
      value=${Math.round(100 * value)}
      aria-valuetext=${text}
      onInput=${onInput}
    />
    <output>${text}</output>
  </label>`;
}

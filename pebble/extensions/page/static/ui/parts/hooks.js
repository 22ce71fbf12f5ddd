// What every widget is made of: templates, the page's services, and values that follow the store.

import * as browser from "../../core/browser.js";
import { visible } from "../../core/json.js";
import { Component, createContext, h, options } from "../../vendor/preact.mjs";
import { useContext, useEffect, useLayoutEffect, useMemo, useReducer, useRef, useState } from "../../vendor/hooks.mjs";
import htm from "../../vendor/htm.mjs";

export { useContext, useEffect, useLayoutEffect, useMemo, useRef, useState };
export const html = htm.bind(h);

const LABEL = "aria-label";

/** All that is drawn or read out passes here. @param {any} node */
options.vnode = (node) => {
  const { type, props } = node;
  if (type === null) node.props = visible(props);
  else if (props[LABEL]) props[LABEL] = visible(props[LABEL]);
};

/** The services that main.js makes: store, connection, commands, driver, video, settings, route. */
export const Page = createContext(null);

/** @returns {any} the services of the page */
export const usePage = () => useContext(Page);

const useRedraw = () => useReducer((n) => n + 1, 0)[1];

/** @typedef {import("../../messages.js").Metrics} Metrics */

/**
 * The store; draw again after its changes, or only after those of what ``pick``, which never changes, makes of the value.
 * @param {string | null} ref null: any @param {string | null} metric null: any @param {(value: any) => unknown} [pick]
 */
function useStore(ref, metric, pick) {
  const { store } = usePage();
  const redraw = useRedraw();
  const drawn = useRef(/** @type {unknown} */ (undefined));
  const picked = () => pick(store.get(ref, metric)?.value);
  if (pick) drawn.current = picked();
  useEffect(() => {
    redraw(); // it may have changed since it was drawn
    return store.subscribe(ref, metric, () => (!pick || picked() !== drawn.current) && redraw());
  }, [store, ref, metric]);
  return store;
}

/**
 * @template {string} M @param {string} ref @param {M} metric @param {(value: any) => unknown} [pick]
 * @returns {import("../../core/store.js").Value<M extends keyof Metrics ? Metrics[M] : any> | undefined}
 */
export const useMetric = (ref, metric, pick) => useStore(ref, metric, pick).get(ref, metric);

/**
 * The payload; undefined until there is one.
 * @template {string} M @param {string} ref @param {M} metric
 * @returns {(M extends keyof Metrics ? Metrics[M] : any) | undefined}
 */
export const useValue = (ref, metric) => useMetric(ref, metric)?.value;

/** @param {string | null} [metric] draw again when it changes at any; else when one comes or goes @returns {string[]} all components */
export const useRefs = (metric = null) => useStore(null, metric).refs();

/** @param {string} ref @returns {string[]} the metrics that were received of it */
export const useMetrics = (ref) => useStore(ref, null).metrics(ref);

/**
 * Draw again after each change of a model, or only after changes of what ``pick``, which never changes, returns.
 * @template {{onChange: (fn: () => void) => () => void}} T @param {T} model @param {(model: T) => unknown} [pick] @returns {T}
 */
export function useModel(model, pick) {
  const redraw = useRedraw();
  const drawn = useRef(/** @type {unknown} */ (undefined));
  drawn.current = pick?.(model);
  useEffect(() => {
    redraw();
    return model.onChange(() => (!pick || pick(model) !== drawn.current) && redraw());
  }, [model]);
  return model;
}

const openness = (connection) => connection.isOpen;

/** @param {string} ref @returns {boolean} whether what was received of it last may still be so */
export function useOnline(ref) {
  const { connection } = usePage();
  useModel(connection, openness);
  return useValue(ref, "web/liveness")?.online !== false && connection.isOpen;
}

/** Draw again every ``ms``, for ages; 0: never. @param {number} ms */
export function useTick(ms) {
  const redraw = useRedraw();
  useEffect(() => {
    if (!ms) return undefined;
    const timer = setInterval(redraw, ms);
    return () => clearInterval(timer);
  }, [ms]);
}

const LONGEST_MS = 60_000; // a timer of more than 24 days would end at once

/** Draw again once, after ``ms`` or a minute; Infinity: never. @param {number} ms */
export function useLater(ms) {
  const redraw = useRedraw();
  useEffect(() => {
    if (!Number.isFinite(ms)) return undefined;
    const timer = setTimeout(redraw, Math.min(ms, LONGEST_MS));
    return () => clearTimeout(timer);
  });
}

/** @param {number} since of performance.now() @param {number} ms @returns {boolean} whether it is not longer ago; draws again then */
export function useRecent(since, ms) {
  const left = since + ms - performance.now();
  useLater(left > 0 ? left : Infinity);
  return left > 0;
}

/** @param {string} query @returns {boolean} whether the media query matches */
export function useMedia(query) {
  const redraw = useRedraw();
  useEffect(() => {
    const list = browser.media(query);
    list.addEventListener("change", redraw);
    return () => list.removeEventListener("change", redraw);
  }, [query]);
  return browser.media(query).matches;
}

const RETRY_MS = 1000;
const TRIES = 3;
const fetched = new Map(); // parts of the page that are here, by what fetches them

/** @param {(again: string) => Promise<any>} part @returns {boolean} whether it can be shown at once */
export const isHere = (part) => fetched.has(part);

let begin;
let rest = new Promise((resolve) => (begin = resolve));

/** What is not needed to see and to drive waits for this, so that it takes nothing from the first picture. */
export const fetchRest = () => (begin(), rest);

/** @param {() => Promise<any>} first fetches what all the rest needs */
export const withRest = (first) => (rest = rest.then(first));

/**
 * @param {(again: string) => Promise<any>} part fetched now, so that it is here when it is shown
 * @param {number} [failures] of before: browsers remember that a module was lost, but not under another address
 */
export async function fetchPart(part, failures = 0) {
  if (!isHere(part)) fetched.set(part, await part(failures ? `?${failures}` : ""));
}

/**
 * A part of the page, fetched when it is first shown. ``failed``: it will not come any more.
 * @param {(again: string) => Promise<any>} part the same one each time @param {boolean} [now] without waiting for fetchRest()
 * @returns {{body: any, failed: boolean}}
 */
export function usePart(part, now = false) {
  const redraw = useRedraw();
  const failures = useRef(0);
  const body = fetched.get(part);
  useEffect(() => {
    let timer = 0;
    let over = Boolean(body);
    async function attempt() {
      try {
        if (!now) await rest;
        await fetchPart(part, failures.current);
      } catch (error) {
        console.error(error);
        failures.current++;
        if (!over) timer = setTimeout(attempt, RETRY_MS * failures.current);
      }
      if (!over) redraw();
    }
    if (!over) attempt();
    return () => {
      over = true;
      clearTimeout(timer);
    };
  }, [part]);
  return { body, failed: failures.current >= TRIES };
}

/** A text that changes at most once a second, so that it can be read aloud. @param {string} text @returns {string} */
export function useCalm(text) {
  const [shown, show] = useState(text);
  const changedAt = useRef(-Infinity);
  useEffect(() => {
    if (text === shown) return undefined;
    const wait = Math.max(0, changedAt.current + 1000 - performance.now());
    const timer = setTimeout(() => {
      changedAt.current = performance.now();
      show(text);
    }, wait);
    return () => clearTimeout(timer);
  }, [text, shown]);
  return shown;
}

/** A part of the page that may fail without the rest. While one fails that is vital, nothing is driven. */
export class Boundary extends Component {
  static contextType = Page;

  componentDidCatch(error) {
    console.error(error);
    this.fails(error);
  }

  componentWillUnmount() {
    this.fails(null);
  }

  fails(error) {
    this.setState({ error });
    if (this.props.vital) this.context.driver.fail(this.props.what, error !== null);
  }

  render({ children, what, vital }, { error }) {
    if (!error) return children;
    return html`<p class="failed" role="alert">
      ${what} failed: ${String(error.message ?? error)}
      <button type="button" onClick=${() => location.reload()}>Reload</button>
      ${vital && html`<button type="button" class="stop" onPointerDown=${() => this.context.commands.stop("")}>STOP ALL</button>`}
    </p>`;
  }
}

/**
 * Fetches a part of the page together with its style sheets, beside app.css; for usePart() and Part.
 * @param {(again: string) => Promise<any>} fetch @param {...string} sheets "cards.css" @returns {(again: string) => Promise<any>}
 */
export const styled =
  (fetch, ...sheets) =>
  async (again) =>
    (await Promise.all([fetch(again), ...sheets.map(fetchStyle)]))[0];

const sheets = new Map(); // promises, by name

/** @param {string} name @returns {Promise<void>} */
export function fetchStyle(name) {
  if (!sheets.has(name)) {
    const link = document.createElement("link");
    link.rel = "stylesheet";
    link.href = new URL(`../../${name}`, import.meta.url).href;
    const loaded = new Promise((resolve, reject) => {
      link.onload = () => resolve(undefined);
      link.onerror = () => {
        sheets.delete(name);
        link.remove();
        reject(new Error(`${name} could not be fetched`));
      };
    });
    sheets.set(name, loaded);
    document.head.append(link);
  }
  return sheets.get(name);
}

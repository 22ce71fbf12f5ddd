// More components than a screen has room for: which of them are wanted, and only those on the screen are drawn.

import { html, useEffect, useLayoutEffect, usePage, useRef, useState } from "../parts/hooks.js";

const BEYOND = 2; // rows above and below the screen, for the keyboard and for who scrolls fast

const kept = { show: "", top: 0 }; // while a robot is looked at

/** What can be chosen besides the groups. ``is``: whether one with these values is of it. */
const KINDS = [
  { title: "Stopped", is: (value) => value("web/estop")?.latched === true },
  { title: "Driven", is: (value) => Boolean(value("web/driver")?.by) },
];
const OFFLINE = "Offline";

/**
 * @param {{groups: {title: string, list: string[]}[], away: string[], card: (ref: string) => any, row: any}} props
 * ``card`` draws one that is online, ``row`` one that is not
 */
export function Many({ groups, away, card, row }) {
  const { store } = usePage();
  const [show, choose] = useState(kept.show);
  kept.show = show;
  useEffect(() => {
    const { top } = kept;
    const timer = setTimeout(() => top && scrollTo(0, top)); // the rows have their height now
    const follow = () => void (kept.top = scrollY);
    addEventListener("scroll", follow, { passive: true });
    return () => {
      clearTimeout(timer);
      removeEventListener("scroll", follow);
    };
  }, []);
  const online = groups.flatMap(({ list }) => list);
  const of = (is) => online.filter((ref) => is((metric) => store.get(ref, metric)?.value));
  const whole = [...groups, { title: OFFLINE, list: away }];
  const every = [...groups, ...KINDS.map(({ title, is }) => ({ title, list: of(is) })), ...whole.slice(-1)];
  if (show && !every.some(({ title }) => title === show)) every.push({ title: show, list: [] });
  const chips = every.filter(({ title, list }) => list.length || title === show);
  const drawn = (show ? every.filter(({ title }) => title === show) : whole).filter(({ list }) => list.length);
  return html`<div class="kinds" role="group" aria-label="Show">
      ${[{ title: "", list: [...online, ...away] }, ...chips].map(
        ({ title, list }) => html`<button
          key=${title}
          type="button"
          class="kind"
          data-test=${`show-${title.toLowerCase().replaceAll(" ", "-") || "all"}`}
          aria-pressed=${show === title}
          onClick=${() => choose(title)}
        >
          ${title || "All"} <span class="dim">${list.length}</span>
        </button>`,
      )}
    </div>
    ${!drawn.length && html`<p class="empty">There are none now.</p>`}
    ${drawn.map(
      ({ title, list }) => html`<section key=${title} aria-label=${title}>
        <h2 class="fleet-group">${title}</h2>
        ${title === OFFLINE
          ? html`<${Rows} refs=${list} look="away-rows" draw=${row} />`
          : html`<${Rows} refs=${list} look="fleet-cards dense" draw=${card} />`}
      </section>`,
    )}`;
}

/** A list of rows of one height, whose columns and height the style sheet decides. */
function Rows({ refs, look, draw }) {
  const place = useRef(/** @type {HTMLUListElement | null} */ (null));
  const drawnBefore = useRef(new Map());
  const [seen, see] = useState([1, 0, 0, 0, 0]);
  const [columns, step, gap, from, to] = seen;
  const measure = () => {
    const style = getComputedStyle(place.current);
    const columns = style.gridTemplateColumns.split(" ").length;
    const gap = parseFloat(style.rowGap) || 0;
    const step = parseFloat(style.gridAutoRows) + gap;
    const top = -place.current.getBoundingClientRect().top;
    const within = (row) => Math.min(Math.ceil(refs.length / columns), Math.max(0, row));
    const first = within(Math.floor(top / step) - BEYOND);
    const next = [columns, step, gap, first, within(Math.ceil((top + innerHeight) / step) + BEYOND)];
    see((old) => (String(old) === String(next) ? old : next));
  };
  const newest = useRef(measure);
  newest.current = measure;
  useLayoutEffect(measure); // what is above it may have grown
  useEffect(() => {
    const follow = () => newest.current();
    addEventListener("scroll", follow, { passive: true });
    addEventListener("resize", follow);
    return () => {
      removeEventListener("scroll", follow);
      removeEventListener("resize", follow);
    };
  }, []);
  const rows = Math.ceil(refs.length / columns);
  const old = drawnBefore.current;
  const drawn = new Map(); // Preact passes over a node that it has drawn before
  refs.slice(from * columns, to * columns).forEach((ref, at) => {
    const number = from * columns + at + 1;
    const key = `${number} of ${refs.length} ${ref}`;
    drawn.set(key, old.get(key) ?? html`<li key=${ref} aria-posinset=${number} aria-setsize=${refs.length}>${draw(ref)}</li>`);
  });
  drawnBefore.current = drawn;
  const height = Math.max(0, rows * step - gap);
  const style = { paddingTop: `${Math.min(from * step, height)}px`, height: `${height}px` }; // else it grows out of sight
  return html`<ul class=${`rows ${look}`} style=${style} ref=${place}>
    ${[...drawn.values()]}
  </ul>`;
}

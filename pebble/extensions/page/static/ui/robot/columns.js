// Balanced columns: cards are placed so that all columns end alike; later only what is below a card moves.

import * as browser from "../../core/browser.js";
import { useLayoutEffect, useRef } from "../parts/hooks.js";

const GAP = 20;
const ROW = 4; // px of a row of the grid: cards end at multiples of it
const SIDE = 340; // the last column, if there is one for driving
const LEAST = 440; // of each other column
const EQUAL = 24; // px by which a top may lie above that of a card before it in the list
const REST_MS = 1000; // so often it is seen whether all cards are here

/** @param {number} width px @param {boolean} hasSide @returns {number} */
const columnsOf = (width, hasSide) => {
  const side = hasSide ? SIDE + GAP : 0;
  return Math.max(1 - Number(hasSide), Math.floor((width - side + GAP) / (LEAST + GAP))) + Number(hasSide);
};

/**
 * ``rows`` in a main column, ``sideRows`` in the last one; ``wide``: it may span several main ones.
 * @typedef {{id: string, rows: number, sideRows: number, span?: string, side: boolean, wide: boolean}} Size
 * @typedef {[number, number, number]} Place its first row, its column, and how many columns it spans
 */

const range = (numbers) => Math.max(...numbers) - Math.min(...numbers);

/**
 * The places by which all columns end most alike, and so do those above a card that spans several. Tops rise along the
 * list: it is the order of reading. Nothing else counts: cards that are as high have the same places.
 * @param {Size[]} cards in their order @param {number} count of columns @param {boolean} hasSide
 * @param {Map<string, number[][]>} [homes] of cards that keep their columns @returns {Place[]}
 */
export function placed(cards, count, hasSide, homes = new Map()) {
  const main = Math.max(1, count - Number(hasSide));
  let best = { cost: Infinity, places: /** @type {Place[]} */ ([]) };
  const go = (/** @type {number[]} */ ends, highest, cost, /** @type {Place[]} */ places) => {
    const card = cards[places.length];
    const total = cost + (card ? 0 : range(ends));
    if (total >= best.cost) return;
    if (!card) return void (best = { cost: total, places });
    for (const [at, span] of homes.get(card.id) ?? choices(card, count, main)) {
      const above = ends.slice(at, at + span);
      const top = Math.max(...above);
      const next = [...ends].fill(top + (at < main ? card.rows : card.sideRows), at, at + span);
      const early = Math.max(0, highest - EQUAL / ROW - top);
      go(next, Math.max(top, highest), cost + range(above) + 1000 * early, [...places, [top, at, span]]);
    }
  };
  go(Array(count).fill(0), 0, 0, []);
  return best.places;
}

/** Columns and spans that a card may have. @param {Size} card @param {number} count @param {number} main */
function choices(card, count, main) {
  if (card.span) return [[0, card.span === "all" ? count : main]];
  if (card.side) return [[count - 1, 1]];
  const columns = Array.from({ length: count }, (_, at) => at);
  return columns.flatMap((at) => columns.slice(0, card.wide ? Math.max(1, main - at) : 1).map((n) => [at, n + 1]));
}

/**
 * Places the children of one grid. Their order in the document is that of keyboard and screen reader: it stays. Columns
 * are chosen by the heights that cards usually have, so they are the same before and after their parts are here.
 */
class Columns {
  /** @param {HTMLElement} grid */
  constructor(grid) {
    this.grid = grid;
    this.homes = new Map();
    this.count = 0;
    this.rests = false;
    this.timer = setTimeout(() => this.rest(), REST_MS);
    this.seen = new Set();
    this.observer = browser.sizes(() => this.place());
    const touched = () => (this.rests = true);
    for (const name of ["pointerdown", "keydown", "wheel"]) addEventListener(name, touched, { passive: true, once: true });
  }

  place() {
    const cards = /** @type {HTMLElement[]} */ ([...this.grid.children]);
    for (const one of [this.grid, ...cards]) if (!this.seen.has(one)) this.observer.observe(one);
    this.seen = new Set([this.grid, ...cards]);
    const hasSide = cards.some((card) => card.dataset.at === "side" && card.offsetHeight > 0);
    const count = columnsOf(this.grid.clientWidth, hasSide);
    if (count !== this.count || !this.rests) this.arrange(cards, count, hasSide);
    this.count = count;
    const sizes = cards.map((card) => sizeOf(card, !this.rests && card.querySelector(".loading") !== null));
    placed(sizes, count, hasSide, this.homes).forEach(([top, at, span], n) => {
      const { id, rows, sideRows } = sizes[n]; // all was read before anything is written
      this.homes.set(id, [[at, span]]);
      const high = hasSide && at === count - 1 ? sideRows : rows;
      const area = `${top + 1} / ${at + 1} / span ${Math.max(1, high)} / span ${span}`;
      if (cards[n].style.gridArea !== area) cards[n].style.gridArea = area; // this runs with each message, too
    });
  }

  arrange(cards, count, hasSide) {
    const main = Math.max(1, count - Number(hasSide));
    this.grid.style.gridTemplateColumns = `repeat(${main}, minmax(0, 1fr))${count > main ? ` ${SIDE}px` : ""}`;
    const lay = (homes) =>
      cards.forEach(({ style }, n) => (style.gridArea = `auto / ${homes[n][0] + 1} / auto / span ${homes[n][1]}`));
    lay(cards.map((card) => choices(sizeOf(card), count, main)[0])); // as wide as they will be
    const sizes = cards.map((card) => sizeOf(card, true));
    const homes = placed(sizes, count, hasSide).map((place) => place.slice(1));
    lay(homes);
    this.homes = new Map(sizes.map(({ id }, n) => [id, [homes[n]]]));
  }

  rest() {
    if (this.grid.querySelector(".loading")) return void (this.timer = setTimeout(() => this.rest(), REST_MS));
    if (!this.rests) this.place();
    this.rests = true;
    this.grid.dataset.rests = "";
  }

  close() {
    clearTimeout(this.timer);
    this.observer.disconnect();
  }
}

const rowsOf = (px) => (px ? Math.ceil((px + GAP) / ROW) : 0);

/** How high it is, or ``usually``. @param {HTMLElement} card @returns {Size} */
function sizeOf({ offsetHeight, className, dataset: { card: id = "", span, at, wide, height, sideHeight } }, usually = false) {
  const usual = usually && height && !className.includes("closed");
  const [rows, sideRows] = (usual ? [+height, +(sideHeight ?? height)] : [offsetHeight, offsetHeight]).map(rowsOf);
  return { id, rows, sideRows, span, side: at === "side", wide: wide !== undefined };
}

/** @returns {{current: any}} for the ``ref`` of the grid */
export function useColumns() {
  const grid = useRef(null);
  const columns = useRef(/** @type {Columns | null} */ (null));
  useLayoutEffect(() => {
    columns.current = new Columns(grid.current);
    return () => columns.current?.close();
  }, []);
  useLayoutEffect(() => columns.current?.place());
  return grid;
}

// Balanced columns: once all cards are here, each goes to the shortest column; later only what is below it in that column moves.

import * as more from "../../core/browser-more.js";
import { useLayoutEffect, useRef } from "../parts/hooks.js";

const GAP = 20;
const ROW = 4; // px of a row of the grid: cards end at multiples of it
const SIDE = 340; // the last column, if there is one for driving
const LEAST = 440; // of each other column
const EQUAL = 24; // px by which a column has to be shorter to be chosen: tops rise along the list

/** @param {number} width px @param {boolean} hasSide @returns {number} */
const columnsOf = (width, hasSide) => {
  const side = hasSide ? SIDE + GAP : 0;
  return Math.max(1 - Number(hasSide), Math.floor((width - side + GAP) / (LEAST + GAP))) + Number(hasSide);
};

/**
 * Where each card is: its column, and its first row. ``homes`` are the columns that were chosen before.
 * @param {{id: string, rows: number, span?: "main" | "all", side?: boolean}[]} cards in their order
 * @param {number} count of columns @param {boolean} hasSide @param {Map<string, number>} homes @returns {Map<string, [number, number, number]>} top, column, span
 */
function placed(cards, count, hasSide, homes) {
  const ends = Array(count).fill(0);
  const places = new Map();
  for (const { id, rows, span, side } of cards) {
    const wide = span === "all" ? count : span === "main" ? Math.max(1, count - Number(hasSide)) : 1;
    const at = span ? 0 : side ? count - 1 : (homes.get(id) ?? shortest(ends));
    const top = Math.max(...ends.slice(at, at + wide));
    homes.set(id, at);
    places.set(id, [top, at, wide]);
    ends.fill(top + rows, at, at + wide);
  }
  return places;
}

function shortest(ends) {
  let at = 0;
  for (let column = 1; column < ends.length; column++) if (ends[column] + EQUAL / ROW < ends[at]) at = column;
  return at;
}

/** Places the children of one grid. Their order in the document is that of keyboard and screen reader: it stays. */
class Columns {
  /** @param {HTMLElement} grid */
  constructor(grid) {
    this.grid = grid;
    this.homes = new Map();
    this.count = 0;
    this.settled = false; // every card is as high as it is
    this.seen = new Set();
    this.observer = more.sizes(() => this.place());
    this.follow(grid);
  }

  /** @param {Element} one */
  follow(one) {
    if (this.seen.has(one)) return;
    this.seen.add(one);
    this.observer.observe(one);
  }

  place() {
    const { grid, homes } = this;
    const cards = /** @type {HTMLElement[]} */ ([...grid.children]);
    cards.forEach((card) => this.follow(card));
    const hasSide = cards.some((card) => card.dataset.at === "side" && card.offsetHeight > 0);
    const count = columnsOf(grid.clientWidth, hasSide);
    if (count !== this.count || !this.settled) {
      this.settled = !grid.querySelector(".loading");
      homes.clear();
      const side = hasSide && count > 1 ? ` ${SIDE}px` : "";
      grid.style.gridTemplateColumns = `repeat(${side ? count - 1 : count}, minmax(0, 1fr))${side}`;
      for (const card of cards) {
        const { span, at } = card.dataset; // as wide as it will be, else its height would be another one
        const wide = span === "all" ? count : Math.max(1, count - Number(hasSide));
        card.style.gridArea = `auto / ${at === "side" ? count : 1} / auto / span ${span ? wide : 1}`;
      }
    }
    this.count = count;
    const known = cards.map((card) => {
      const { card: id = "", span, at } = card.dataset;
      const rows = card.offsetHeight ? Math.ceil((card.offsetHeight + GAP) / ROW) : 0;
      return { id, rows, span: /** @type {any} */ (span), side: at === "side", card };
    });
    const places = placed(known, count, hasSide, homes); // all was read before anything is written
    for (const { id, rows, card } of known) {
      const [top, at, wide] = places.get(id) ?? [0, 0, 1];
      const area = `${top + 1} / ${at + 1} / span ${Math.max(1, rows)} / span ${wide}`;
      if (card.style.gridArea !== area) card.style.gridArea = area; // this runs with each message, too
    }
  }

  close() {
    this.observer.disconnect();
  }
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

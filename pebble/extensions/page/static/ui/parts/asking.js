// What came of what was asked of a component.

import { useEffect, useModel, usePage, useRef, useState, useTick } from "./hooks.js";

/** What stands between the slashes of a topic; the server refuses any other name. */
const LEVEL = /^[^/+#\0]{1,64}$/u;

/** @param {string} name @returns {boolean} whether a command can carry this name in its topic */
export const isLevel = (name) => LEVEL.test(name);

const answersOf = (connection) => connection.answers;

/** @typedef {{n?: number, op: "" | "asked" | "done" | "refused", why?: string}} Progress */

/** @type {Progress} */
const NONE = { op: "" };
/** @type {Progress} */
const UNSENT = { op: "refused", why: "no connection to the server" };

/**
 * What came of a command so far: "asked" until the server has answered.
 * @param {number | undefined} n its number; 0: it was not sent; undefined: there is none @returns {Progress}
 */
export function useAnswer(n) {
  const { connection } = usePage();
  useModel(connection, answersOf);
  const last = useRef(NONE); // the connection remembers only the newest answers
  if (!n) return n === 0 ? UNSENT : NONE;
  last.current = connection.answers.get(n) ?? (last.current.n === n ? last.current : { n, op: "asked" });
  return last.current;
}

/**
 * What a switch was asked to be, until it reports that, or anything else.
 * @param {boolean | null | undefined} is what it reports @param {number} lateMs from when on that is not confirmed
 */
export function useWish(is, lateMs) {
  const [wish, set] = useState(/** @type {{on: boolean, was: any, at: number, n: number} | null} */ (null));
  const answer = useAnswer(wish?.n);
  useEffect(() => {
    if (wish && (is === wish.on || is !== wish.was)) set(null);
  }, [wish, is]);
  const refused = answer.op === "refused" ? answer.why : "";
  const waits = wish !== null && is !== wish.on && !refused;
  useTick(waits ? 500 : 0);
  const late = waits && performance.now() - wish.at > lateMs;
  const ask = (on, n) => set({ on, was: is, at: performance.now(), n });
  return { wish, waits, late, refused, ask };
}

// What came of what was asked of a component.

import { useModel, usePage, useRef } from "./hooks.js";

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

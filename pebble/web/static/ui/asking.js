// Whether something can be asked of a component besides driving, and what came of it.

import { useModel, usePage, useValue } from "./hooks.js";
import { nameOf } from "./words.js";

/** What stands between the slashes of a topic; the server refuses any other name. */
const LEVEL = /^[^/+#\0]{1,64}$/u;

/** @param {string} name @returns {boolean} whether a command can carry this name in its topic */
export const isLevel = (name) => LEVEL.test(name);

const asWhom = (connection) => `${connection.isOpen} ${connection.may("drive")}`;

/**
 * Why nothing can be asked of it now; "" it can.
 * @param {string} at @param {string} what "to switch outlets" @returns {string}
 */
export function useWhyNot(at, what) {
  const { connection } = usePage();
  useModel(connection, asWhom);
  const broker = useValue("", "web/broker");
  const liveness = useValue(at, "web/liveness");
  if (!connection.isOpen) return "No connection to the server";
  if (broker?.connected === false) return "The server cannot reach the broker";
  if (!connection.may("drive")) return `Log in as driver ${what}`;
  if (liveness?.online === false) return `${nameOf(at)} is silent`;
  return "";
}

const answersOf = (connection) => connection.answers;

/**
 * Why the server has not passed on what was asked; "" it has, as far as is known.
 * @param {string} at @param {string} cmd "outlet" @param {{answer: unknown} | null} asked ``answer``: the last one then
 * @returns {string}
 */
export function useRefusal(at, cmd, asked) {
  const { connection } = usePage();
  useModel(connection, answersOf);
  const answer = connection.answerTo(cmd, at);
  return asked !== null && answer !== asked.answer && answer?.op === "refused" ? answer.why : "";
}

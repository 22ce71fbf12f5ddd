// Why nothing can be asked of a component now, besides driving: the first reason counts.

import { useModel, usePage, useValue } from "./hooks.js";
import { nameIn } from "./looks.js";

/** @typedef {{store: import("../../core/store.js").Store, connection: import("./models.js").Connection}} Services */

const ROLES = { drive: "driver", system: "maintainer" }; // the least that have the right

/**
 * Why this page may not even end anything: what ends something is asked of every robot, also of one that is silent.
 * @param {Services} page @param {"drive" | "system"} [right] @returns {string} "" it may
 */
export function whyNotEnd(page, right = "drive") {
  return whyNotReached(page) || (page.connection.may(right) ? "" : `Log in as ${ROLES[right]} to use this`);
}

/** Why nothing reaches any robot; "" it does. @param {Services} page @returns {string} */
export function whyNotReached({ store, connection }) {
  if (!connection.isOpen) return "No connection to the server";
  return store.get("", "web/broker")?.value.connected === false ? "The server cannot reach the broker" : "";
}

/**
 * Why it cannot be asked for anything, or for what this section of its capabilities offers; "" it can.
 * @param {Services} page @param {string} ref @param {string} [section] @param {"drive" | "system"} [right]
 * @returns {string}
 */
export function whyNot(page, ref, section = "", right = "drive") {
  const why = whyNotEnd(page, right);
  if (why) return why;
  const { store } = page;
  if (store.get("", "web/broker")?.value.problem) return "The server cannot reach the broker";
  if (store.get(ref, "web/liveness")?.value.online === false) return `${nameIn(store, ref)} is silent`;
  return sectionOf(store.get(ref, "capabilities")?.value, section).controls === false
    ? `${nameIn(store, ref)} takes no such commands`
    : "";
}

/**
 * Why nothing that moves or is switched on by it can be asked for; "" it can.
 * @param {Services} page @param {string} ref @param {string} [section] @returns {string}
 */
export function whyNotMoved(page, ref, section = "") {
  const why = whyNot(page, ref, section);
  return why || (page.connection.you?.drives === false ? "Needs https: this connection is not encrypted" : "");
}

/** @param {any} capabilities payload @param {string} name @returns {Record<string, any>} empty if there is none */
export const sectionOf = (capabilities, name) => capabilities?.value?.[name] ?? {};

const picked = ({ isOpen, you }) => `${isOpen} ${you?.role}`;

/** Draw again when any of the reasons may have changed. @param {string} at @returns {any} the services of the page */
export function useReasons(at) {
  const page = usePage();
  useModel(page.connection, picked);
  useValue("", "web/broker");
  useValue(at, "web/liveness");
  useValue(at, "capabilities");
  return page;
}

// Whether drive commands and stops reach the motors of a robot, as its own status says. Fetched after the first picture.

import { callAll } from "../../core/store.js";
import { html, useEffect, usePage, useValue } from "../parts/hooks.js";
import { inner } from "../parts/words.js";

const LONGEST = 200; // characters of a reason

/**
 * Why drive commands and stops may have no effect; "" no such reason is known.
 * @param {unknown} status payload @returns {{no: boolean, text: string}} ``no``: they have none
 */
export function doubtOf(status) {
  const { state, why } = inner(status)?.driveable ?? {};
  const no = state === "no";
  const words = no ? "Cannot be driven" : state === "unknown" ? "Not known whether it can be driven" : "";
  return { no, text: words && typeof why === "string" ? `${words}: ${why.slice(0, LONGEST)}` : words };
}

/** A mark in the header; the line beside the stick says why. @param {{at: string}} props */
export function DoubtMark({ at }) {
  const { driver } = usePage();
  const { no, text } = doubtOf(useValue(at, "status"));
  useEffect(() => {
    driver.doubt = no ? { code: "doubt", text } : null;
    callAll(driver.watchers);
    return () => void (driver.doubt = null);
  }, [at, no, text]);
  if (!text) return null;
  return html`<span class=${`doubt-mark ${no ? "bad" : "late"}`} title=${text} data-test="doubt-mark"
    ><span aria-hidden="true">${no ? "▲" : "?"}</span> <span class="sr">${text}</span></span
  >`;
}

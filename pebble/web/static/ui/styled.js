// Cards with a style sheet of their own.

import { fetchStyle, html } from "./hooks.js";
import { Part } from "./parts.js";

/**
 * ``body``, drawn once the sheet is here.
 * @param {string} sheet @param {(props: any) => any} body @returns {(props: any) => any}
 */
export function styled(sheet, body) {
  async function part() {
    await fetchStyle(sheet);
    return body;
  }
  return (props) => html`<${Part} part=${part} ...${props} />`;
}

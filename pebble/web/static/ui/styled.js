// Parts of the page with a style sheet of their own.

import { fetchStyle, html, usePart } from "./hooks.js";

/** The same component, drawn once its style sheet is here. @param {string} name "system.css" @param {any} Body */
export function styled(name, Body) {
  const sheet = async () => {
    await fetchStyle(name);
    return true;
  };
  return (props) => (usePart(sheet).body ? html`<${Body} ...${props} />` : null);
}

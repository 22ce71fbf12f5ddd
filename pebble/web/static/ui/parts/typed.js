// Fields whose text counts once they are left, or Enter is pressed.

import { html, useState } from "./hooks.js";

/** What is being typed outlives redraws. @param {any} props those of an input; ``onDone`` is given its text */
export function Typed({ value, onDone, ...props }) {
  const [typed, type] = useState(/** @type {string | null} */ (null)); // null: nothing is
  const done = (event) => {
    onDone(event.currentTarget.value);
    type(null);
  };
  return html`<input
    ...${props}
    value=${typed ?? value}
    onInput=${(event) => type(event.currentTarget.value)}
    onChange=${done}
    onBlur=${() => type(null)}
  />`;
}

// Fields whose text counts once they are left, or Enter is pressed; and what is wrong with what was typed.

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

/**
 * Show the first field of a form that the browser refuses. Steps are only those of its arrows, but for whole numbers.
 * @param {any} form @returns {boolean} whether there is one
 */
export function refuses(form) {
  const wrong = [...form.elements].find(isWrong);
  if (!wrong) return false;
  const folded = wrong.closest("details");
  if (folded) folded.open = true;
  wrong.reportValidity();
  return true;
}

const isWrong = ({ validity, step }) =>
  !validity.valid && (step === "1" || !validity.stepMismatch || validity.rangeUnderflow || validity.rangeOverflow);

// What is wrong with what was typed.

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

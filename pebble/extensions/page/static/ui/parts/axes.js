// Whether the open robot has an axis besides turning and going; without one, nothing on the page speaks of it.

import { usePage, useValue } from "./hooks.js";
import { Offers } from "./models.js";

/** @returns {boolean} */
export function useExtraAxis() {
  const { ref } = usePage().driver;
  return new Offers(ref, useValue(ref, "capabilities")).hasExtraAxis;
}

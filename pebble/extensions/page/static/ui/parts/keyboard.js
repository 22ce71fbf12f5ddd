// What keys drive: what is printed on them, where browsers tell, and whether the robot has an axis for them.

import * as more from "../../core/browser-more.js";
import { keyName } from "../../core/actions.js";
import { useEffect, usePage, useState, useValue } from "./hooks.js";
import { Offers } from "./models.js";

/** @returns {boolean} whether the open robot has an axis besides turning and going; else nothing speaks of it */
export function useExtraAxis() {
  const { ref } = usePage().driver;
  return new Offers(ref, useValue(ref, "capabilities")).hasExtraAxis;
}

/** @returns {(code: string) => string} */
export function useKeyNames() {
  const [layout, setLayout] = useState(null);
  useEffect(() => {
    more.keyboardLayout().then(setLayout, () => {});
  }, []);
  return (code) => keyName(code, layout ?? undefined);
}

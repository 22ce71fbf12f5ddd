// What is printed on the keys of this keyboard, where browsers tell.

import * as more from "../../core/browser-more.js";
import { keyName } from "../../core/actions.js";
import { useEffect, useState } from "./hooks.js";

/** @returns {(code: string) => string} */
export function useKeyNames() {
  const [layout, setLayout] = useState(null);
  useEffect(() => {
    more.keyboardLayout().then(setLayout, () => {});
  }, []);
  return (code) => keyName(code, layout ?? undefined);
}

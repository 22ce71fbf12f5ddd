// What is printed on the keys of this keyboard, where browsers tell.

import { keyName } from "../core/actions.js";
import { useEffect, useState } from "./hooks.js";

/** @returns {(code: string) => string} */
export function useKeyNames() {
  const [layout, setLayout] = useState(null);
  useEffect(() => {
    const { keyboard } = /** @type {any} */ (navigator);
    keyboard?.getLayoutMap?.().then(setLayout, () => {}); // not in a frame of another site
  }, []);
  return (code) => keyName(code, layout ?? undefined);
}

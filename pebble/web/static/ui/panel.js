// A panel, not a modal dialog: STOP stays in reach. Opening one ends the gesture.

import { html, useEffect, usePage, useRef } from "./hooks.js";
import { Icon } from "./parts.js";

/** @param {{id: string, title: string, onClose: () => void, children: any}} props */
export function Panel({ id, title, onClose, children }) {
  const { driver } = usePage();
  const panel = useRef(/** @type {HTMLElement | null} */ (null));
  useEffect(() => {
    const before = /** @type {HTMLElement | null} */ (document.activeElement);
    driver.interrupt();
    panel.current?.focus();
    return () => before?.focus?.();
  }, []);
  const key = (event) => event.key === "Escape" && onClose();
  return html`<dialog open class="panel" ref=${panel} tabindex="-1" aria-labelledby=${`${id}-title`} onKeyDown=${key}>
    <div class="card-head">
      <h2 id=${`${id}-title`}>${title}</h2>
      <button
        type="button"
        class="quiet"
        data-test=${`close-${id}`}
        aria-label=${`Close ${title.toLowerCase()}`}
        onClick=${onClose}
      >
        <${Icon} name="close" />
      </button>
    </div>
    ${children}
  </dialog>`;
}

// The frame of all panels: no modal dialogs, because STOP stays in reach. While one is open, nothing is driven.

import { html, useEffect, usePage, useRef } from "./hooks.js";
import { Icon } from "./parts.js";

/** @param {{id: string, title: string, className?: string, children?: any}} props */
export function Panel({ id, title, className = "", children }) {
  const { driver, panels } = usePage();
  const element = useRef(null);
  useEffect(() => {
    const before = /** @type {HTMLElement | null} */ (document.activeElement);
    driver.interrupt();
    element.current.focus();
    return () => {
      driver.interrupt();
      before?.focus?.();
    };
  }, []);
  const close = () => panels.show("");
  return html`<dialog
    open
    class=${`panel ${className}`}
    ref=${element}
    tabindex="-1"
    data-test=${`panel-${id}`}
    aria-labelledby=${`${id}-title`}
    onKeyDown=${(event) => event.key === "Escape" && close()}
  >
    <div class="card-head">
      <h2 id=${`${id}-title`}>${title}</h2>
      <button type="button" class="quiet" data-test="close-panel" aria-label=${`Close: ${title}`} onClick=${close}>
        <${Icon} name="close" />
      </button>
    </div>
    ${children}
  </dialog>`;
}

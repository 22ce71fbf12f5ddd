// The frame of all panels: no modal dialogs, because STOP stays in reach. While one is open, nothing is driven.

import { html, useEffect, usePage, useRef } from "../parts/hooks.js";
import { Button } from "../parts/parts.js";

/** @param {{id: string, title: string, onClose: () => void, className?: string, children?: any}} props */
export function Panel({ id, title, onClose, className = "", children }) {
  const { driver } = usePage();
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
  useEffect(() => {
    if (document.activeElement === document.body) element.current.focus(); // what had it is gone
  });
  return html`<dialog
    open
    class=${`panel ${className}`}
    ref=${element}
    tabindex="-1"
    data-test=${`panel-${id}`}
    aria-labelledby=${`${id}-title`}
    onKeyDown=${(event) => event.key === "Escape" && onClose()}
  >
    <div class="card-head">
      <h2 id=${`${id}-title`}>${title}</h2>
      <${Button} className="quiet" test=${`close-${id}`} label=${`Close ${title.toLowerCase()}`} icon="close" onPress=${onClose} />
    </div>
    ${children}
  </dialog>`;
}

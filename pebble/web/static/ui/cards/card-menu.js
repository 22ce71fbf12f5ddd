// What can be done with a card: close, hide and move it.

import { html, useRef, useState } from "../parts/hooks.js";
import { Icon } from "../parts/parts.js";

/** ``ids``: the cards among which it can be moved, in their order. */
export function CardMenu({ title, id, view, isFirst, ids }) {
  const [open, show] = useState(false);
  const place = useRef(/** @type {HTMLElement | null} */ (null));
  const end = (event) => event.type === "focusout" && place.current?.contains(event.relatedTarget) ? undefined : show(false);
  const item = (words, does, off = false) => html`<button
    type="button"
    disabled=${off}
    onClick=${() => {
      show(false);
      does();
    }}
  >
    ${words}
  </button>`;
  const at = ids.indexOf(id);
  return html`<div
    class="card-menu"
    ref=${place}
    onFocusOut=${end}
    onKeyDown=${(event) => event.key === "Escape" && show(false)}
  >
    <button
      type="button"
      class="quiet"
      data-test=${`menu-${id}`}
      aria-expanded=${open}
      aria-label=${`${title}: close, hide, move`}
      onClick=${() => show(!open)}
    >
      <${Icon} name="dots" />
    </button>
    ${open &&
    html`<div class="card-menu-list" role="group" aria-label=${title}>
      ${item(`Close ${title}`, () => view.toggle(id, isFirst))} ${item(`Hide ${title}`, () => view.hide(id))}
      ${item("Move up", () => view.move(ids, id, -1), at <= 0)}
      ${item("Move down", () => view.move(ids, id, 1), at === ids.length - 1)}
      ${item("Arrange as new", () => view.reset())}
    </div>`}
  </div>`;
}

// The empty state of a card: what is missing, and what to do about it.

import { html } from "./hooks.js";
import { Icon } from "./parts.js";

/** @param {{icon: string, what: string, children: any}} props ``children``: what to do, in a line */
export const Nothing = ({ icon, what, children }) => html`<div class="nothing" data-test=${`nothing-${icon}`}>
  <${Icon} name=${icon} />
  <p><b>${what}</b></p>
  <p>${children}</p>
</div>`;

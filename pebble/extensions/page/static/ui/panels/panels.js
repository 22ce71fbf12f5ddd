// All panels: one of them can be open above each screen.

import { HelpPanel } from "./help.js";
import { html } from "../parts/hooks.js";
import { PhonePanel } from "./phone.js";
import { SettingsPanel } from "./settings.js";

const PANELS = { settings: SettingsPanel, help: HelpPanel, phone: PhonePanel };

/** The panel that is shown. */
export const Panels = ({ shown, onClose }) => html`<${PANELS[shown]} key=${shown} onClose=${onClose} />`;

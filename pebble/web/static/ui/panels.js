// All panels: one of them can be open above each screen.

import { GamepadPanel } from "./gamepad.js";
import { HelpPanel } from "./help.js";
import { fetchStyle, html } from "./hooks.js";
import { PhonePanel } from "./phone.js";
import { SettingsPanel } from "./settings.js";

const PANELS = { settings: SettingsPanel, help: HelpPanel, gamepad: GamepadPanel, phone: PhonePanel };

/** @returns {Promise<any>} what draws the panel that is shown */
export async function fetched() {
  await fetchStyle("panels.css");
  return ({ shown, onClose }) => html`<${PANELS[shown]} key=${shown} onClose=${onClose} />`;
}

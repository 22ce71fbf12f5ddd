// A panel, not a modal dialog: STOP stays in reach. Who I am, and how the page looks.

import { html, useEffect, useModel, usePage, useRef } from "./hooks.js";
import { Icon } from "./parts.js";
import { nameOf } from "./words.js";

const THEMES = { auto: "as the system", light: "light", dark: "dark" };
const RIGHTS = { drive: "drive", reset: "reset stops", system: "restart and update robots", people: "manage users" };

export function SettingsPanel({ onClose }) {
  const { settings, driver } = usePage();
  useModel(settings);
  useModel(driver);
  const panel = useRef(null);
  useEffect(() => {
    const before = /** @type {HTMLElement | null} */ (document.activeElement);
    driver.interrupt();
    panel.current.focus();
    return () => before?.focus?.();
  }, []);
  const key = (event) => event.key === "Escape" && onClose();
  return html`<dialog open class="panel" ref=${panel} tabindex="-1" aria-labelledby="settings-title" onKeyDown=${key}>
    <div class="card-head">
      <h2 id="settings-title">Settings</h2>
      <button type="button" class="quiet" aria-label="Close settings" onClick=${onClose}>
        <${Icon} name="close" />
      </button>
    </div>
    <${WhoAmI} />
    <fieldset>
      <legend>Colours</legend>
      <div class="choices">
        ${Object.entries(THEMES).map(
          ([value, text]) => html`<label key=${value} class="check"
            ><input
              type="radio"
              data-test=${`theme-${value}`}
              name="theme"
              checked=${settings.theme === value}
              onChange=${() => settings.set("theme", value)}
            /><span>${text}</span></label
          >`,
        )}
      </div>
    </fieldset>
    ${driver.ref &&
    html`<fieldset>
      <legend>Driving, in this tab</legend>
      <label class="check"
        ><input
          type="checkbox"
          data-test="in-sight"
          checked=${driver.inSight}
          onChange=${(event) => {
            driver.inSight = event.currentTarget.checked;
            driver.changed();
          }}
        /><span>I can see ${nameOf(driver.ref)}: drive with an old picture, too</span></label
      >
    </fieldset>`}
  </dialog>`;
}

function WhoAmI() {
  const { connection, commands } = usePage();
  useModel(connection);
  const { you } = connection;
  if (!you) return html`<p class="dim">Not connected yet.</p>`;
  const rights = (you.rights ?? []).map((one) => RIGHTS[one] ?? one);
  return html`<section class="who" aria-label="Who I am">
    <span class="badge"><${Icon} name="person" /></span>
    <p>
      <b>${you.login ? you.user : "No login on this machine"}</b>
      <span class="dim">${you.role} at ${you.server}. May ${["stop", ...rights].join(", ")}.</span>
    </p>
    ${you.login &&
    html`<button type="button" onClick=${() => commands.logOut()}><${Icon} name="out" />Log out</button>`}
  </section>`;
}

// A panel, not a modal dialog: STOP stays in reach. Who I am, and how the page looks.

import { html, useModel, usePage } from "./hooks.js";
import { NoticeList } from "./notices.js";
import { Panel } from "./panel.js";
import { Icon } from "./parts.js";
import { styled } from "./styled.js";
import { nameOf } from "./words.js";

const THEMES = { auto: "as the system", light: "light", dark: "dark" };
const RIGHTS = { drive: "drive", reset: "reset stops", system: "restart and update robots", people: "manage users" };

export const SettingsPanel = styled("notices.css", SettingsBody);

function SettingsBody({ onClose }) {
  const { settings, driver } = usePage();
  useModel(settings);
  useModel(driver);
  const narrow = !document.querySelector(".bell"); // else the list is behind a button of its own
  return html`<${Panel} id="settings" title="Settings" onClose=${onClose}>
    <${WhoAmI} />
    ${narrow &&
    html`<section class="panel-part" aria-labelledby="notices-heading">
      <h3 id="notices-heading">Notices</h3>
      <${NoticeList} onGo=${onClose} />
    </section>`}
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
  <//>`;
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
    ${you.login
      ? html`<button type="button" onClick=${() => commands.logOut()}><${Icon} name="out" />Log out</button>`
      : html`<${OwnName} you=${you} />`}
  </section>`;
}

/** Without a login everybody would be called the same. */
function OwnName({ you }) {
  const { commands, settings } = usePage();
  useModel(settings);
  const change = (event) => {
    const name = event.currentTarget.value.trim();
    if (name !== settings.name) commands.setName(name);
  };
  return html`<div class="own-name">
    <label
      >Your name on this page
      <input
        type="text"
        maxlength="32"
        autocomplete="nickname"
        data-test="own-name"
        aria-describedby="own-name-why"
        value=${settings.name}
        onChange=${change}
    /></label>
    <span class="why" id="own-name-why">Others see “${you.user}”. Nobody checks it: here is no login.</span>
  </div>`;
}

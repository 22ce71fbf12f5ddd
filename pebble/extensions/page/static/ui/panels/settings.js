// Who I am, and how the page looks and is used in this browser.

import { html, useModel, usePage } from "../parts/hooks.js";
import { lacks } from "../parts/lacks.js";
import { NoticeList } from "../fleet/notices.js";
import { Panel } from "./panel.js";
import { Button, Check, Icon } from "../parts/parts.js";
import { RecordingsLink } from "../fleet/recordings-link.js";

const THEMES = { auto: "As the system", light: "Light", dark: "Dark" };
const SIDES = { left: "On the left", right: "On the right" };

export function SettingsPanel({ onClose }) {
  const { settings, driver, panels } = usePage();
  useModel(settings);
  useModel(driver);
  const narrow = !document.querySelector(".bell"); // else the list is behind a button of its own
  return html`<${Panel} id="settings" title="Settings" onClose=${onClose}>
    <${WhoAmI} />
    ${lacks().map((one) => html`<p key=${one} class="panel-text why" data-test="lacks">${one}</p>`)}
    ${narrow &&
    html`<section class="panel-part" aria-labelledby="notices-heading">
      <h3 id="notices-heading">Notices</h3>
      <${NoticeList} onGo=${onClose} />
    </section>`}
    <${Choice} name="theme" title="Colours" choices=${THEMES} />
    <${Choice} name="side" title="Stick, on a phone" choices=${SIDES} />
    <fieldset>
      <legend>Driving</legend>
      <${Check} test="hints" checked=${settings.hints} onChange=${(checked) => settings.set("hints", checked)}>
        Show which keys drive
      <//>
      ${driver.ref &&
      html`<${Check}
        test="in-sight"
        checked=${driver.inSight}
        onChange=${(checked) => {
          driver.inSight = checked;
          driver.changed();
        }}
      >
        Allow driving with an old picture (this tab)
      <//>`}
    </fieldset>
    <div class="panel-links">
      <div onClick=${onClose}><${RecordingsLink} at=${driver.ref} className="button wide" /></div>
      <${Button} className="wide" test="open-help" icon="help" onPress=${() => panels.show("help")}>Help<//>
      <${Button} className="wide" test="open-phone" icon="phone" onPress=${() => panels.show("phone")}>Open on a phone<//>
    </div>
  <//>`;
}

function Choice({ name, title, choices }) {
  const { settings } = usePage();
  return html`<fieldset>
    <legend>${title}</legend>
    <div class="choices">
      ${Object.entries(choices).map(
        ([value, text]) => html`<label key=${value} class="check"
          ><input
            type="radio"
            data-test=${`${name}-${value}`}
            name=${name}
            checked=${settings[name] === value}
            onChange=${() => settings.set(name, value)}
          /><span>${text}</span></label
        >`,
      )}
    </div>
  </fieldset>`;
}

function WhoAmI() {
  const { connection, commands } = usePage();
  useModel(connection);
  const { you } = connection;
  if (!you) return html`<p class="dim">Not connected yet.</p>`;
  return html`<section class="who" aria-label="Who I am">
    <span class="badge"><${Icon} name="person" /></span>
    <p>
      <b>${you.login ? you.user : "No login on this machine"}</b>
      <span class="dim">${you.role} at ${you.server}</span>
    </p>
    ${you.login
      ? html`<${Button} icon="out" onPress=${() => commands.logOut()}>Log out<//>`
      : html`<${OwnName} you=${you} />`}
  </section>`;
}

/** Without a login everybody would be called the same. */
function OwnName({ you }) {
  const { commands, settings } = usePage();
  useModel(settings);
  const change = (text) => {
    const name = text.trim();
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
        defaultValue=${settings.name}
        onChange=${(event) => change(event.currentTarget.value)}
    /></label>
    <span class="why" id="own-name-why">Others see “${you.user}” (no login here)</span>
  </div>`;
}

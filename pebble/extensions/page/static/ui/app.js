// The frame of every screen: header, banners, the fleet or one component, and the settings.

import * as browser from "../core/browser.js";
import { Banners } from "./banner.js";
import { Header } from "./header.js";
import { Boundary, fetchRest, html, styled, useEffect, useMedia, useModel, usePage, useState } from "./parts/hooks.js";
import { Part, useName } from "./parts/parts.js";

/** What is fetched when it is first shown, so that the first screen is there soon; main.js fetches the rest later. */
export const PARTS = {
  fleet: styled(async (again) => (await import("./fleet/fleet.js" + again)).Fleet, "fleet.css"),
  robot: async (again) => (await import("./robot/robot.js" + again)).Robot,
  panels: styled(async (again) => (await fetchRest(), await import("./panels/panels.js" + again)).Panels, "panels.css", "notices.css"),
};

/** Not among them: few people look at recordings. */
const REPLAY = styled(async (again) => (await import("./replay/replay.js" + again)).Replay, "replay.css");

/** @returns {"desktop" | "portrait" | "immersive"} how the page is laid out */
export function useLayout() {
  const { route } = usePage();
  const [full, setFull] = useState(browser.fullScreen.on);
  useEffect(() => {
    const change = () => setFull(browser.fullScreen.on);
    document.addEventListener("fullscreenchange", change);
    return () => document.removeEventListener("fullscreenchange", change);
  }, []);
  const lying = useMedia("(orientation: landscape) and (max-height: 500px) and (pointer: coarse)");
  const narrow = useMedia("(max-width: 760px)");
  if (route.ref && (lying || (full && !narrow))) return "immersive";
  return narrow ? "portrait" : "desktop";
}

export function App() {
  const { route, settings, panels } = usePage();
  const { ref, replay } = useModel(route);
  useModel(settings);
  const layout = useLayout();
  const name = useName(ref);
  const { shown } = useModel(panels);
  const [drawer, setDrawer] = useState(false);
  useEffect(() => {
    document.title = ref ? `${name} – Pebble` : replay === null ? "Pebble" : "Recordings – Pebble";
    setDrawer(false);
  }, [ref, replay, name]);
  const toggle = () => panels.toggle("settings");
  return html`<div class=${`app ${layout} ${ref ? "at-robot" : "at-fleet"}`}>
    <a class="skip" href="#main">Skip to content</a>
    <${Boundary} vital what="The header">
      <${Header}
        at=${ref}
        layout=${layout}
        panel=${shown === "settings"}
        onPanel=${toggle}
        drawer=${drawer}
        onDrawer=${() => setDrawer(!drawer)}
      />
    <//>
    <${Boundary} vital what="The banner"><${Banners} at=${ref} /><//>
    ${shown &&
    html`<${Boundary} key=${shown} what="This panel"
      ><${Part} part=${PARTS.panels} now shown=${shown} onClose=${() => panels.show("")}
    /><//>`}
    <main id="main" tabindex="-1">
      <${Boundary} key=${ref || `replay ${replay}`} vital what="This screen">
        ${ref
          ? html`<${Part}
              part=${PARTS.robot}
              now
              key=${ref}
              at=${ref}
              layout=${layout}
              drawer=${drawer}
              onPanel=${toggle}
            />`
          : replay === null
            ? html`<${Part} part=${PARTS.fleet} now />`
            : html`<${Part} part=${REPLAY} now key=${replay} at=${replay} />`}
      <//>
    </main>
  </div>`;
}

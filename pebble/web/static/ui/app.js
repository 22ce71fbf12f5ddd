// The frame of every screen: header, banners, the fleet or one component, and the settings.

import { Banners } from "./banner.js";
import { Fleet } from "./fleet.js";
import { Header } from "./header.js";
import { Boundary, html, useEffect, useMedia, useModel, usePage, useState } from "./hooks.js";
import { Robot } from "./robot.js";
import { SettingsPanel } from "./settings.js";
import { nameOf } from "./words.js";

/** @returns {"desktop" | "portrait" | "immersive"} how the page is laid out */
export function useLayout() {
  const { route } = usePage();
  const [full, setFull] = useState(Boolean(document.fullscreenElement));
  useEffect(() => {
    const change = () => setFull(Boolean(document.fullscreenElement));
    document.addEventListener("fullscreenchange", change);
    return () => document.removeEventListener("fullscreenchange", change);
  }, []);
  const lying = useMedia("(orientation: landscape) and (max-height: 500px) and (pointer: coarse)");
  const narrow = useMedia("(max-width: 760px)");
  if (route.ref && (lying || (full && !narrow))) return "immersive";
  return narrow ? "portrait" : "desktop";
}

export function App() {
  const { route, settings } = usePage();
  const { ref } = useModel(route);
  useModel(settings);
  const layout = useLayout();
  const [panel, setPanel] = useState(false);
  const [drawer, setDrawer] = useState(false);
  useEffect(() => {
    document.title = ref ? `${nameOf(ref)} – Pebble` : "Pebble";
    setDrawer(false);
  }, [ref]);
  const toggle = () => setPanel(!panel);
  return html`<div class=${`app ${layout} ${ref ? "at-robot" : "at-fleet"}`}>
    <a class="skip" href="#main">Skip to content</a>
    <${Boundary} what="The header">
      <${Header}
        at=${ref}
        layout=${layout}
        panel=${panel}
        onPanel=${toggle}
        drawer=${drawer}
        onDrawer=${() => setDrawer(!drawer)}
      />
    <//>
    <${Boundary} what="The banner"><${Banners} at=${ref} layout=${layout} /><//>
    ${panel && html`<${Boundary} what="Settings"><${SettingsPanel} onClose=${toggle} /><//>`}
    <main id="main" tabindex="-1">
      <${Boundary} what="This screen">
        ${ref
          ? html`<${Robot} key=${ref} at=${ref} layout=${layout} drawer=${drawer} onPanel=${toggle} />`
          : html`<${Fleet} />`}
      <//>
    </main>
  </div>`;
}

// The address of this screen as a QR code; or why a phone cannot open it.

import { ROOT } from "../../core/browser.js";
import * as more from "../../core/browser-more.js";
import { generate } from "../../vendor/lean-qr.mjs";
import { html, useEffect, useModel, usePage } from "../parts/hooks.js";
import { Route } from "../parts/models.js";
import { Panel } from "./panel.js";
import { useName } from "../parts/parts.js";

const QUIET = 4; // modules around the code

export function PhonePanel({ onClose }) {
  const { ref } = useModel(usePage().route);
  return html`<${Panel} id="phone" onClose=${onClose} title="Open on a phone">
    ${more.isLoopback(location.hostname) ? html`<${OnlyHere} />` : html`<${Code} at=${ref} />`}
  <//>`;
}

function Code({ at }) {
  const { settings } = usePage();
  const name = useName(at);
  useEffect(() => settings.begin("phone"), []);
  const address = location.origin + Route.path(at, false);
  return html`<div class="panel-text">
    <${Drawn} text=${address} />
    <p class="address" data-test="address">${address}</p>
    <p>
      ${at ? `Opens ${name}.` : "Opens the list of all robots."} The phone has to be in this network, and its user logs
      in; there is no password in the code.
    </p>
    ${location.protocol === "https:" &&
    html`<p class="dim">
      If the phone does not trust the certificate: let it install <span class="address">${location.origin}${ROOT}ca.pem</span>
    </p>`}
  </div>`;
}

function Drawn({ text }) {
  const code = /** @type {any} */ (generate)(text);
  const lines = Array.from({ length: code.size }, (_, at) => at);
  const path = lines.flatMap((y) => lines.flatMap((x) => (code.get(x, y) ? `M${x} ${y}h1v1h-1z` : []))).join("");
  const size = code.size + 2 * QUIET;
  return html`<svg
    class="qr"
    role="img"
    aria-label=${`QR code of ${text}`}
    viewBox=${`${-QUIET} ${-QUIET} ${size} ${size}`}
    shape-rendering="crispEdges"
  >
    <rect x=${-QUIET} y=${-QUIET} width=${size} height=${size} fill="#fff" />
    <path d=${path} fill="#000" />
  </svg>`;
}

function OnlyHere() {
  const { connection } = usePage();
  const port = location.port ? `:${location.port}` : "";
  const server = connection.you?.server ?? "";
  const name = /^[\w-]{1,60}$/.test(server) ? `${server}.local` : "lab-pc.local";
  return html`<div class="panel-text" data-test="only-here">
    <p>
      <b>A phone cannot open ${location.host}:</b> on every machine, this is the address of that machine itself.
    </p>
    ${server === more.DEMO
      ? html`<p>End the demo, and start it with a certificate, a login, and a code in its terminal:</p>
          <pre>make demo PHONE=1</pre>`
      : location.protocol === "https:"
      ? html`<p>Open this page by the name that is in its certificate, and come back here for the code.</p>`
      : html`<p>For other machines, the page needs https and a login. On this computer, type once:</p>
          <pre>
pebble cert init ${name} 192.168.1.20
pebble web user add ann --role driver</pre
          >
          <p>Use its own name and address. Then start the page for all machines:</p>
          <pre>pebble web goob.json --host 0.0.0.0</pre>
          <p>and open <span class="address">https://${name}${port}</span>, which has a code here.</p>`}
  </div>`;
}

// The way to what was recorded, where this server has recordings; fetched after the first picture.

import { ROOT } from "../../core/browser.js";
import { html, useModel, usePage } from "../parts/hooks.js";
import { Route, WATCHES } from "../parts/models.js";
import { Icon, RouteLink } from "../parts/parts.js";

/** @param {string} ref "": all @returns {string} the address of its recordings */
export const recordingsOf = (ref) => `${ROOT}replay${ref && Route.path(ref, false).slice(`${ROOT}r`.length)}`;

/** @param {{at?: string, className?: string}} props ``at``: of this component only */
export function RecordingsLink({ at = "", className = "button" }) {
  const { connection } = usePage();
  useModel(connection, (one) => one.you);
  if (!connection.you?.recordings || WATCHES) return null;
  return html`<${RouteLink} path=${recordingsOf(at)} className=${className} label="Recordings"
    ><${Icon} name="recordings" /><span>Recordings</span><//
  >`;
}

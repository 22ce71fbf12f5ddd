// The gamepads that were set up in this browser.

import { USUAL } from "../../core/inputs.js";
import { validMapping } from "../../core/pad-mapping.js";
import { Model, read, write } from "./models.js";

const MOST = 16; // that are remembered

class Pads extends Model {
  constructor() {
    super();
    const stored = Object.entries(read("pads", {})).slice(0, MOST);
    this.mappings = new Map(stored.map(([id, mapping]) => [id, validMapping(mapping)]));
  }

  /** @param {string} id @returns {import("../../core/inputs.js").Mapping} */
  mappingOf(id) {
    return this.mappings.get(id) ?? USUAL;
  }

  /** @param {string} id @param {import("../../core/inputs.js").Mapping | null} mapping null: the usual one */
  set(id, mapping) {
    this.mappings.delete(id);
    if (mapping) this.mappings.set(id, mapping);
    write("pads", Object.fromEntries([...this.mappings].slice(-MOST)));
    this.changed();
  }
}

export const pads = new Pads();

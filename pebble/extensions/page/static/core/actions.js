/**
 * Everything that keys, gamepad and fingers do, as data: the bindings and the help are made of it. Pure.
 *
 * Driving and stopping are bound by driver.js and inputs.js, whose keys are listed here. All others begin, prolong and
 * end no gesture; whatever ends a gesture lets go of what is held.
 */

import { BACK, DOWN, FORWARD, LEFT, PAD_ESTOP, RIGHT, UP, USUAL } from "./inputs.js";

/**
 * @typedef {object} Action
 * @property {string} id
 * @property {string} words
 * @property {readonly string[]} [keys] by event.code: the same place on every keyboard
 * @property {readonly string[]} [signs] by event.key: these are elsewhere on every keyboard
 * @property {string} [keyWords] where the keys say too little
 * @property {number} [button] of a gamepad: standard layout, and Attack 3
 * @property {string} [pad] where a button says too little
 * @property {string} [touch]
 * @property {boolean} [driving] bound by driver.js
 * @property {boolean} [anywhere] also where no component is open
 * @property {boolean} [held] it lasts until it is released
 * @property {boolean} [repeats] while the key is held
 */

/** @type {readonly Action[]} */
export const ACTIONS = [
  { id: "forward", words: "Drive forward", keys: FORWARD, pad: "stick", touch: "stick", driving: true },
  { id: "back", words: "Drive back", keys: BACK, pad: "stick", touch: "stick", driving: true },
  { id: "left", words: "Turn left", keys: LEFT, pad: "stick", touch: "stick", driving: true },
  { id: "right", words: "Turn right", keys: RIGHT, pad: "stick", touch: "stick", driving: true },
  {
    id: "stop",
    words: "Stop for now",
    keys: ["Space"],
    button: USUAL.buttons.stop,
    touch: "lift the finger",
    driving: true,
    anywhere: true,
  },
  {
    id: "estop",
    words: "STOP: emergency stop, until it is reset",
    keyWords: "Ctrl+Enter (⌘+Enter), Ctrl+Space, or Esc twice",
    pad: `buttons ${PAD_ESTOP.map((index) => index + 1).join(" and ")} together`,
    touch: "STOP",
    driving: true,
    anywhere: true,
  },
  {
    id: "auxiliary",
    words: "Extra axis (grousers)",
    keys: [...UP, ...DOWN],
    button: USUAL.buttons.auxiliary,
    pad: "hold it, and stick left or right",
    touch: "+ and −, held",
    driving: true,
  },
  { id: "slower", words: "Slower", signs: ["-"], button: 13, touch: "slider", repeats: true },
  { id: "faster", words: "Faster", signs: ["+", "="], button: 12, touch: "slider", repeats: true },
  { id: "flash", words: "Flash lights on and off", keys: ["KeyF"], button: 3, touch: "card Lights" },
  { id: "mute", words: "Mute what you listen to", keys: ["KeyM"], button: 4, touch: "button under the picture" },
  { id: "repeat", words: "Play the last sound again", keys: ["KeyP"], button: 5, touch: "card Sounds" },
  { id: "talk", words: "Talk, while it is held", keys: ["KeyT"], button: 6, touch: "button, held", held: true },
  { id: "help", words: "This help", signs: ["?"], touch: "More, Settings", anywhere: true },
];

const BOUND = ACTIONS.filter((action) => !action.driving);

/** @param {Action} action @param {import("./inputs.js").Mapping} mapping @returns {number} -1: none */
export const buttonOf = (action, mapping) => mapping.buttons[action.id] ?? action.button ?? -1;

/** By its sign first: on French keyboards ? is on KeyM. @param {{code: string, key: string}} event @returns {Action | undefined} */
const actionOf = ({ code, key }) =>
  BOUND.find((one) => one.signs?.includes(key)) ?? BOUND.find((one) => one.keys?.includes(code));

/** Which actions begin and end, from keys and the buttons of a gamepad. */
export class Actions {
  /**
   * @param {(id: string, phase: "down" | "up") => void} act "up" is only of actions that are held
   * @param {() => boolean} [isOpen] whether a component is: most actions are of one
   */
  constructor(act, isOpen = () => true) {
    this.act = act;
    this.isOpen = isOpen;
    /** @type {Map<string, string>} actions that are held, and by what */
    this.held = new Map();
    this.padName = "";
    /** @type {Set<string>} what was pressed when the gamepad was last read */
    this.pressed = new Set();
  }

  /** @param {{code: string, key: string, repeat: boolean}} event @returns {boolean} whether the key has an action */
  keyDown(event) {
    const action = actionOf(event);
    if (!action) return false;
    if (!event.repeat || action.repeats) this.begin(action, event.code);
    return true;
  }

  /** @param {string} code */
  keyUp(code) {
    for (const [id, by] of this.held) if (by === code) this.end(id);
  }

  /**
   * What the gamepad shows now; null: there is none, or the window has lost the focus. A button that is pressed when
   * the gamepad appears counts after it was released.
   * @param {any} pad @param {import("./inputs.js").Mapping} mapping
   */
  padSample(pad, mapping) {
    const name = pad ? `${pad.index} ${pad.id}` : "";
    const isNew = name !== this.padName;
    this.padName = name;
    for (const action of BOUND) {
      const was = this.pressed.has(action.id);
      const is = pad?.buttons[buttonOf(action, mapping)]?.pressed === true;
      if (is) this.pressed.add(action.id);
      else this.pressed.delete(action.id);
      if (is && !was && !isNew) this.begin(action, "gamepad");
      if ((!is || isNew) && this.held.get(action.id) === "gamepad") this.end(action.id);
    }
  }

  /** Whatever is held counts as released. */
  clear() {
    for (const id of this.held.keys()) this.end(id);
  }

  begin(action, by) {
    if (!(action.anywhere || this.isOpen()) || this.held.has(action.id)) return;
    if (action.held) this.held.set(action.id, by);
    this.emit(action.id, "down");
  }

  end(id) {
    this.held.delete(id);
    this.emit(id, "up");
  }

  /** A little later: what it does must not keep a stop from being sent. */
  emit(id, phase) {
    queueMicrotask(() => this.act(id, phase));
  }
}

const ARROWS = { ArrowUp: "↑", ArrowDown: "↓", ArrowLeft: "←", ArrowRight: "→" };

/**
 * What is printed on a key.
 * @param {string} code @param {{get: (code: string) => string | undefined}} [layout] of this keyboard, where browsers tell
 */
export function keyName(code, layout) {
  return ARROWS[code] ?? layout?.get(code)?.toUpperCase() ?? code.replace(/^Key/, "");
}

const STANDARD = [
  ..."ABXY",
  ...["LB", "RB", "LT", "RT", "Back", "Start", "left stick", "right stick"],
  ...["up", "down", "left", "right"].map((one) => `d-pad ${one}`),
];

/** @param {number} index @param {boolean} standard whether it has the layout that browsers call so */
export const buttonName = (index, standard) => (standard && STANDARD[index]) || `button ${index + 1}`;

// A form made of what a robot lists: one field for each setting of a script. The browser checks what is typed.

import { html } from "../parts/hooks.js";
import { Button } from "../parts/parts.js";
import { hint, isMissing, option, usual } from "./form-model.js";
import { plain } from "../parts/more-words.js";

/**
 * ``texts``: what is there when the form is drawn first. ``onText``: what was typed; null is the default.
 * @param {{id: string, fields: import("./form-model.js").Field[], texts: import("./form-model.js").Texts,
 *   onText: (key: string, text: string | null) => void}} props
 */
export const Form = ({ id, fields, texts, onText }) => html`<div class="ask-form">
  ${fields.map(
    (field, index) => html`<${FormField}
      key=${field.key}
      id=${`${id}-${index}`}
      field=${field}
      text=${texts.get(field.key)}
      onText=${(text) => onText(field.key, text === usual(field) ? null : text || null)}
    />`,
  )}
</div>`;

function FormField({ id, field, text, onText }) {
  const Input = INPUTS[kindOf(field)];
  const name = plain(field.label);
  const restore = (event) => {
    const input = /** @type {HTMLInputElement} */ (document.getElementById(id));
    if (field.type === "bool") input.checked = usual(field) === "true";
    else input.value = usual(field);
    if (event.detail === 0) input.focus(); // by a key: this button is about to go
    onText(null);
  };
  return html`<div class="ask-field">
    <label for=${id}>${name}${isMissing(field) && html` <span class="required">(required)</span>`}</label>
    <div class="ask-row">
      <${Input} id=${id} data-test=${`set-${field.key}`} title=${hint(field)} required=${isMissing(field)} field=${field} text=${text} onText=${onText} />
      ${text !== undefined &&
      field.default !== null &&
      html`<${Button}
        test=${`restore-${field.key}`}
        label=${`Restore the default of ${name}: ${option(field.type, usual(field))}`}
        onPress=${restore}
      >
        Default
      <//>`}
    </div>
  </div>`;
}

/** @param {import("./form-model.js").Field} field */
function kindOf({ type, default: usual, options }) {
  if (type === "bool" && usual === null) return "enum";
  return type === "enum" && !options ? "string" : type;
}

/** It keeps what is typed by itself. Once it is left empty, its default is there again. @param {any} props */
function TextInput({ field, text, onText, ...props }) {
  const leave = ({ currentTarget: input }) => {
    if (!input.value && !input.validity.badInput) input.value = usual(field);
  };
  return html`<input
    type="text"
    autocomplete="off"
    spellcheck="false"
    maxlength="256"
    pattern="[^\\-].*"
    ...${props}
    defaultValue=${text ?? usual(field)}
    onInput=${(event) => onText(event.currentTarget.value)}
    onBlur=${leave}
  />`;
}

/** @param {any} props */
function NumberInput(props) {
  const { min, max, step, type } = props.field;
  const numeric = type === "int" && min >= 0 ? "numeric" : undefined;
  return html`<${TextInput} type="number" inputmode=${numeric} min=${min} max=${max} step=${step ?? (type === "int" ? 1 : "any")} ...${props} />`;
}

/** @param {any} props */
function Switch({ field, text, onText, ...props }) {
  const on = (text ?? usual(field)) === "true";
  return html`<label class="check">
    <input type="checkbox" role="switch" ...${props} required=${false} defaultChecked=${on} onChange=${(event) => onText(String(event.currentTarget.checked))} />
    <span aria-hidden="true">${on ? "on" : "off"}</span>
  </label>`;
}

/** @param {any} props */
function Choice({ field, text, onText, ...props }) {
  const { options = ["true", "false"], required, type } = field;
  const listed = options.includes(usual(field));
  const none = field.default !== null ? `Default (${plain(field.default)})` : required ? "Choose…" : "Not set";
  const chosen = text ?? usual(field);
  return html`<select ...${props} onChange=${(event) => onText(event.currentTarget.value)}>
    ${!listed && html`<option value="">${none}</option>`}
    ${options.map((one) => html`<option key=${one} value=${one} selected=${one === chosen}>${option(type, one)}</option>`)}
  </select>`;
}

const INPUTS = { string: TextInput, int: NumberInput, float: NumberInput, bool: Switch, enum: Choice };

// A form made of what a robot lists: one field for each setting of a script.

import { html } from "../parts/hooks.js";
import { MISSING, UNREADABLE, hint, option } from "./form-model.js";
import { plain } from "../parts/more-words.js";

/**
 * ``onText``: what was typed, of which "" is nothing yet; null restores the default.
 * @param {{id: string, fields: import("./form-model.js").Field[], texts: import("./form-model.js").Texts,
 *   mistakes: Map<string, string>, onText: (key: string, text: string | null) => void}} props
 */
export const Form = ({ id, fields, texts, mistakes, onText }) => html`<div class="ask-form">
  ${fields.map(
    (field, index) => html`<${FormField}
      key=${field.key}
      id=${`${id}-${index}`}
      field=${field}
      text=${texts.get(field.key)}
      mistake=${mistakes.get(field.key)}
      onText=${(text) => onText(field.key, text)}
    />`,
  )}
</div>`;

function FormField({ id, field, text, mistake, onText }) {
  const wrong = mistake === MISSING ? "" : mistake;
  const Input = INPUTS[field.type === "bool" && field.default === null ? "enum" : field.type];
  const restore = (event) => {
    const input = document.getElementById(id);
    // one for numbers may show what it does not report
    if (input instanceof HTMLInputElement && input.type === "number") input.value = field.default;
    if (event.detail === 0) input?.focus(); // by a key: this button is about to go
    onText(null);
  };
  return html`<div class=${`ask-field ${wrong ? "wrong" : ""}`}>
    <label for=${id}>${plain(field.label)}${field.required && field.default === null && html` <span class="required">(required)</span>`}</label>
    <div class="ask-row">
      <${Input} id=${id} field=${field} text=${text} wrong=${wrong} onText=${onText} />
      ${text !== undefined &&
      field.default !== null &&
      html`<button
        type="button"
        data-test=${`restore-${field.key}`}
        aria-label=${`Restore the default of ${plain(field.label)}: ${option(field.type, field.default)}`}
        onClick=${restore}
      >
        Default
      </button>`}
    </div>
    <span class="why" id=${`${id}-why`} data-test=${`why-${field.key}`}
      >${wrong ? html`<b class="bad">${wrongWords(wrong, hint(field))}</b>` : mistake && hint(field)}</span
    >
  </div>`;
}

const wrongWords = (wrong, accepted) => `${wrong.charAt(0).toUpperCase()}${wrong.slice(1)}${accepted && `. ${accepted}`}`;

/** What all kinds of inputs have in common. */
const common = ({ id, field, wrong }) => ({
  id,
  "data-test": `set-${field.key}`,
  "aria-describedby": `${id}-why`,
  "aria-invalid": wrong ? "true" : undefined,
  "aria-required": field.required && field.default === null ? "true" : undefined,
});

/** An input that was emptied stays so until it is left: then its default is there again. */
const typing = (field, onText) => ({
  onInput: (event) => {
    const { value, validity } = event.currentTarget;
    const text = validity.badInput ? UNREADABLE : value;
    onText(text === field.default || (text === "" && field.default === null) ? null : text);
  },
  onBlur: (event) => event.currentTarget.value === "" && !event.currentTarget.validity.badInput && onText(null),
});

/** @param {any} props */
function TextInput({ text, onText, ...props }) {
  return html`<input
    type="text"
    ...${common(props)}
    autocomplete="off"
    spellcheck="false"
    value=${text ?? props.field.default ?? ""}
    ...${typing(props.field, onText)}
  />`;
}

/**
 * While its text is no number yet, as a lone sign, browsers report it as empty: it must stay as it was typed.
 * @param {any} props
 */
function NumberInput({ text, onText, ...props }) {
  const { min, max, step, type, default: usual } = props.field;
  return html`<input
    type="number"
    ...${common(props)}
    inputmode=${type === "int" && min !== null && min >= 0 ? "numeric" : undefined}
    min=${min ?? undefined}
    max=${max ?? undefined}
    step=${step ?? (type === "int" ? 1 : "any")}
    value=${text === UNREADABLE ? undefined : (text ?? usual ?? "")}
    ...${typing(props.field, onText)}
  />`;
}

/** @param {any} props */
function Switch({ text, onText, ...props }) {
  const usual = props.field.default;
  const on = (text ?? usual) === "true";
  const change = (event) => {
    const value = String(event.currentTarget.checked);
    onText(value === usual ? null : value);
  };
  return html`<label class="check">
    <input type="checkbox" role="switch" ...${common(props)} checked=${on} onChange=${change} />
    <span aria-hidden="true">${on ? "on" : "off"}</span>
  </label>`;
}

/** @param {any} props */
function Choice({ text, onText, ...props }) {
  const { options, default: usual, required, type } = props.field;
  const listed = usual !== null && options.includes(usual);
  const none = usual !== null ? `default (${plain(usual)})` : required ? "choose…" : "not set";
  const change = (event) => onText(["", usual].includes(event.currentTarget.value) ? null : event.currentTarget.value);
  return html`<select ...${common(props)} value=${text ?? (listed ? usual : "")} onChange=${change}>
    ${!listed && html`<option value="">${none}</option>`}
    ${options.map((one) => html`<option key=${one} value=${one}>${option(type, one)}</option>`)}
  </select>`;
}

const INPUTS = { text: TextInput, int: NumberInput, float: NumberInput, bool: Switch, enum: Choice };

// The lights of a robot: a colour, steady or flashing.

import { html, useModel } from "../parts/hooks.js";
import { LONGEST_S, SHORTEST_S, lightsOf, toggleFlash, whyNotLights } from "./lights-model.js";
import { Button, Why, useName } from "../parts/parts.js";
import { useReasons, whyNotEnd } from "../parts/why-not.js";

const COLOURS = {
  red: "#ff0000",
  orange: "#ff8800",
  yellow: "#ffdd00",
  green: "#00ff00",
  cyan: "#00ffff",
  blue: "#0000ff",
  violet: "#aa00ff",
  white: "#ffffff",
};

export function Lights({ at }) {
  const page = useReasons(at);
  const lights = useModel(lightsOf(at));
  const noSolid = whyNotLights(page, at, "solid");
  const noFlash = whyNotLights(page, at, "flash");
  const off = Boolean(noSolid && noFlash);
  const why = off ? noSolid : noSolid || noFlash;
  const colour = (value) => lights.ask(page, { colour: value, mode: noSolid ? "flash" : undefined });
  const mode = (value) => lights.ask(page, { mode: value });
  return html`<div class="lights">
    <div class="swatches" role="group" aria-label="Colour">
      ${Object.entries(COLOURS).map(
        ([name, value]) => html`<${Button}
          key=${name}
          className="swatch"
          title=${name}
          test=${`colour-${name}`}
          aria-pressed=${lights.colour === value}
          why=${off ? why : ""}
          because="why-lights"
          onPress=${() => colour(value)}
        >
          <i aria-hidden="true" style=${{ background: value }}></i><span class="sr">${name}</span>
        <//>`,
      )}
      <label class=${`swatch other ${off ? "off" : ""}`}>
        <input
          type="color"
          data-test="colour"
          aria-describedby=${why ? "why-lights" : undefined}
          disabled=${off}
          value=${lights.colour}
          onInput=${(event) => colour(event.currentTarget.value)}
        />
        <span class="sr">other colour</span>
      </label>
    </div>
    <div class="ask-row">
      <${ModeButton} lights=${lights} mode="solid" why=${noSolid} onPress=${() => mode("solid")}>Solid<//>
      <${ModeButton} lights=${lights} mode="flash" why=${noFlash} onPress=${() => toggleFlash(page, at)}
        >Flash <kbd aria-hidden="true">F</kbd><//
      >
      <${ModeButton} lights=${lights} mode="off" why=${whyNotEnd(page)} onPress=${() => mode("off")}>Off<//>
      <${Period} page=${page} lights=${lights} why=${noFlash} />
    </div>
    ${why && html`<${Why} id="why-lights">${why}<//>`}
    <p class="dim" data-test="lights-asked">${asked(lights, useName(at))}</p>
  </div>`;
}

const ModeButton = ({ lights, mode, ...more }) => html`<${Button}
  test=${`lights-${mode}`}
  aria-pressed=${lights.mode === mode}
  because="why-lights"
  ...${more}
/>`;

function Period({ page, lights, why }) {
  const done = ({ currentTarget: input }) => {
    const seconds = input.valueAsNumber;
    if (!(seconds >= SHORTEST_S && seconds <= LONGEST_S)) input.value = lights.period;
    else if (lights.mode === "flash") lights.ask(page, { period: seconds });
    else lights.setPeriod(seconds);
  };
  return html`<label class="field">
    <span>Period, s</span>
    <input
      key=${lights.period}
      type="number"
      data-test="lights-period"
      min=${SHORTEST_S}
      max=${LONGEST_S}
      step="0.05"
      defaultValue=${lights.period}
      disabled=${Boolean(why)}
      aria-describedby=${why ? "why-lights" : undefined}
      onChange=${done}
    />
  </label>`;
}

function asked({ mode, colour, period }, robot) {
  if (!mode) return `Lights unknown: ${robot} does not report them`;
  const name = Object.entries(COLOURS).find(([, value]) => value === colour)?.[0] ?? colour;
  const what = { solid: `${name}, solid`, flash: `${name}, flashing every ${period} s`, off: "off" };
  return `Asked last: ${what[mode]}`;
}

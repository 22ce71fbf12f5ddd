// The clips that a robot can play.

import { html, useMemo, useModel, useOnline, useValue } from "../parts/hooks.js";
import { Button, Check, Why, useName } from "../parts/parts.js";
import { grouped, play, repeatLast, soundsOf } from "./sounds-model.js";
import { useReasons, whyNot, whyNotEnd } from "../parts/why-not.js";
import { plain } from "../parts/more-words.js";

const MOST = 60; // clips that are listed at a time
const FEW = 8; // they need no filter

export function Sounds({ at }) {
  const page = useReasons(at);
  const sounds = useModel(soundsOf(at));
  const why = whyNot(page, at, "soundboard");
  return html`<div class="sounds">
    <${Clips} at=${at} page=${page} sounds=${sounds} why=${why} />
    ${why && html`<${Why} id="why-again">${why}<//>`}
    <div class="ask-row">
      <${Check} test="repeat" checked=${sounds.repeat} onChange=${(repeat) => sounds.set({ repeat })}>Repeat until stopped<//>
      ${sounds.last &&
      html`<${Button} test="repeat-last" why=${why} because="why-again" icon="play" onPress=${() => repeatLast(page, at)}>
        Again <kbd aria-hidden="true">P</kbd>
      <//>`}
    </div>
    <${NowPlaying} at=${at} page=${page} />
  </div>`;
}

/** What plays, and its end; of a robot that does not report it only the end. */
function NowPlaying({ at, page }) {
  const status = useValue(at, "soundboard-status");
  const { playing, file, error } = status ?? {};
  const why = whyNotEnd(page);
  const was = useOnline(at) ? "plays" : "played when it was last seen";
  return html`<div class="ask-row ask-now">
      <p role="status" data-test="playing">${playing && html`<b>♪ ${plain(file ?? "a clip")}</b> ${was}`}</p>
      ${(playing || !status) &&
      html`<${Button} test="stop-sound" why=${why} icon="halt" onPress=${() => page.commands.stopSound(at)}>Stop sound<//>
        ${why && html`<${Why} id="why-stop-sound">${why}<//>`}`}
    </div>
    ${error && html`<p class="bad" data-test="sound-error">✖ ${plain(error)}</p>`}`;
}

function Clips({ at, page, sounds, why }) {
  const name = useName(at);
  const { files } = useValue(at, "soundboard-files") ?? {};
  const { filter } = sounds;
  const shown = useMemo(() => grouped(files ?? [], filter, MOST), [files, filter]);
  const { playing, file: now } = useValue(at, "soundboard-status") ?? {};
  if (!files) return html`<p class="dim">No list of clips was received yet: is soundboard_handler enabled in its config?</p>`;
  if (!files.length) return html`<p class="dim">No clips: put sound files into ${name}'s folder of sounds.</p>`;
  return html`${(files.length > FEW || filter) &&
    html`<input
      type="search"
      class="wide"
      data-test="sound-filter"
      aria-label="Filter the clips"
      placeholder=${`Filter ${files.length} clips`}
      value=${filter}
      onInput=${(event) => sounds.set({ filter: event.currentTarget.value })}
    />`}
    <div class="clips" data-test="clips" role="group" aria-label="Clips" tabindex="0" data-arrows>
      ${shown.folders.map(
        ([folder, names]) => html`<section key=${folder} aria-label=${folder ? plain(folder) : "clips"}>
          ${folder && html`<h3>${plain(folder)}</h3>`}
          <ul>
            ${names.map(
              (file) => html`<li key=${file}>
                <${Clip} at=${at} page=${page} file=${file} folder=${folder} plays=${playing && file === now} why=${why} />
              </li>`,
            )}
          </ul>
        </section>`,
      )}
      ${!shown.folders.length && html`<p class="dim">No clip matches “${filter}”.</p>`}
      ${shown.more > 0 && html`<p class="dim" data-test="more-clips">… ${shown.more} more: use the filter.</p>`}
    </div>`;
}

/** Without what kind of file it is. @param {string} name */
const called = (name) => plain(name).replace(/\.(wav|mp3|ogg|flac|opus)$/i, "");

function Clip({ at, page, file, folder, plays, why: whyNotPlay }) {
  const why = plays ? whyNotEnd(page) : whyNotPlay;
  const press = () => {
    const problem = why || (plays ? "" : play(page, at, file, soundsOf(at).repeat));
    if (problem) page.connection.show(problem);
    else if (plays) page.commands.stopSound(at);
  };
  return html`<${Button}
    className=${`clip ${plays ? "on" : ""}`}
    test="clip"
    label=${`${plays ? "Stop" : "Play"} ${plain(file)}`}
    why=${why}
    because=${plays ? "why-stop-sound" : "why-again"}
    icon=${plays ? "halt" : "play"}
    onPress=${press}
  >
    <span>${called(file.slice(folder.length) || file)}</span>
  <//>`;
}

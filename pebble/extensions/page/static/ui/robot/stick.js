// The round stick: one finger, captured; whatever takes the finger away lets the stick go.

import * as browser from "../../core/browser.js";
import { html, useEffect, useRef, useState } from "../parts/hooks.js";

const REACH = 0.36; // of the width: how far the knob travels

export function Stick({ driver }) {
  const element = useRef(null);
  const place = useRef(new DOMRect()); // where it was touched: what appears above it later must not turn the robot
  const [knob, setKnob] = useState({ x: 0, z: 0 });
  const [pointer, setPointer] = useState(null);
  const reason = driver.reason();
  const dragged = pointer !== null && driver.inputs.pointer === pointer;
  useEffect(() => () => driver.stickEnd(), []);

  const move = (event) => {
    const box = place.current;
    let x = (event.clientX - box.left - box.width / 2) / (box.width * REACH);
    let z = -(event.clientY - box.top - box.height / 2) / (box.height * REACH);
    const length = Math.hypot(x, z);
    if (length > 1) [x, z] = [x / length, z / length];
    setKnob({ x, z });
    driver.stick(x, z);
  };
  const down = (event) => {
    event.preventDefault();
    element.current.focus({ preventScroll: true });
    if (dragged) return driver.interrupt(); // a second finger
    if (event.pointerId === pointer) driver.stickEnd(); // its release was not reported
    if (driver.reason()) return driver.hint();
    if (event.button || !driver.stickStart(event.pointerId, event.timeStamp)) return undefined;
    browser.capture(event);
    place.current = element.current.getBoundingClientRect();
    setPointer(event.pointerId);
    return move(event);
  };
  const mine = (event) => event.pointerId === pointer;
  const release = (event) => {
    if (!mine(event)) return;
    setPointer(null);
    driver.stickEnd();
  };
  const cancel = (event) => {
    if (!mine(event)) return;
    setPointer(null);
    driver.interrupt();
    driver.stickEnd();
  };
  const { x, z } = dragged ? knob : shown(driver);
  return html`<div
    ref=${element}
    class=${`stick ${dragged ? "dragged" : ""} ${driver.gestureActive ? "active" : ""}`}
    role="application"
    data-test="stick"
    tabindex="0"
    aria-label="Drive stick: drag it, or use the keys W A S D"
    aria-disabled=${Boolean(reason)}
    aria-describedby="why-drive"
    onPointerDown=${down}
    onPointerMove=${(event) => mine(event) && move(event)}
    onPointerUp=${release}
    onPointerCancel=${cancel}
    onLostPointerCapture=${release}
  >
    <span class="stick-arrow n"></span><span class="stick-arrow e"></span>
    <span class="stick-arrow s"></span><span class="stick-arrow w"></span>
    <span class="knob" style=${{ transform: `translate(${120 * x}%, ${-120 * z}%)` }}></span>
  </div>`;
}

/** What keys and gamepad ask for, as a place of the knob. */
function shown({ output, sliders }) {
  const part = (value, most) => Math.max(-1, Math.min(1, most > 0 ? value / most : 0));
  return { x: part(output.x, sliders.turn), z: part(output.z, sliders.speed) };
}

// What the worker of sound pushes, to the loudspeaker: by an AudioWorklet, or without one, by what browsers had before.

import * as browser from "../core/browser.js";
import { Ring } from "./ring.js";

const BLOCK = 1024;
const LIMIT_S = 1;
const WORKLET = new URL("./playout-worklet.js", import.meta.url).href;

/**
 * @param {AudioContext} context
 * @returns {Promise<{node: AudioNode, attach: (port: MessagePort) => void}>} ``attach`` gives it the port of a worker
 */
export async function makeSpeaker(context) {
  if (!context.audioWorklet) return oldSpeaker(context);
  await context.audioWorklet.addModule(WORKLET);
  const options = { numberOfInputs: 0, outputChannelCount: [2] };
  const node = new (browser.find("AudioWorkletNode"))(context, "pebble-playout", options);
  return { node, attach: (port) => node.port.postMessage({ port }, [port]) };
}

/** @param {AudioContext} context */
function oldSpeaker(context) {
  const node = context.createScriptProcessor(BLOCK, 0, 2);
  let ring = new Ring(LIMIT_S * context.sampleRate);
  let played = 0;
  /** @type {MessagePort|null} */
  let worker = null;
  node.onaudioprocess = ({ outputBuffer }) => {
    ring.pull(outputBuffer.getChannelData(0), outputBuffer.getChannelData(1));
    played += BLOCK;
    worker?.postMessage({ played, removed: ring.removed });
  };
  const attach = (/** @type {MessagePort} */ port) => {
    worker?.close();
    worker = port;
    ring = new Ring(LIMIT_S * context.sampleRate);
    port.onmessage = ({ data }) => ring.push(data.left, data.right);
  };
  return { node, attach };
}

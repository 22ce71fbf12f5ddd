// The worker of pictures.js: messages of the server in, bitmaps out, in the order of the messages.

import { PictureDecoder, decodeJpeg } from "./picture-decoder.js";

export const [DRAWN, KEYFRAME_WANTED, CANNOT_DECODE] = [0, 1, 2];
const HEAD_BYTES = 5; // u32 number, u8 kind
const RESCUE_BYTES = HEAD_BYTES + 8; // and the time of capture

const decoder = new PictureDecoder();
let connection = -1;
let newest = -1; // connection that messages come by
let work = Promise.resolve();

self.onmessage = ({ data }) => {
  newest = data.connection;
  work = work.then(() => take(data.connection, data.message, data.quiet));
};

/**
 * @param {number} from the connection that the message came by; another one begins anew
 * @param {ArrayBuffer} message
 * @param {boolean} quiet it is not shown: only the following ones build on it
 */
async function take(from, message, quiet) {
  if (from !== newest) return; // what it belongs to is over
  if (from !== connection) {
    decoder.restart();
    connection = from;
  }
  const view = new DataView(message);
  const seq = view.getUint32(0);
  let made;
  try {
    made = view.getUint8(4) === 1 ? await rescued(message, view) : await direct(message, quiet);
  } catch (error) {
    made = { what: KEYFRAME_WANTED, problem: String(error) };
  }
  self.postMessage({ connection: from, seq, ...made }, { transfer: made.bitmap ? [made.bitmap] : [] });
}

/** @param {ArrayBuffer} message @param {boolean} quiet */
async function direct(message, quiet) {
  const made = await decoder.feed(new Uint8Array(message, HEAD_BYTES), quiet);
  if (made) return { what: DRAWN, problem: "", rescue: false, ...made };
  const { wantsKeyframe, problem } = decoder.sequence;
  if (decoder.unsupported) return { what: CANNOT_DECODE, problem };
  return { what: wantsKeyframe ? KEYFRAME_WANTED : DRAWN, problem: wantsKeyframe ? problem : "" };
}

/** @param {ArrayBuffer} message @param {DataView} view */
async function rescued(message, view) {
  const capturedMs = Number(view.getBigUint64(HEAD_BYTES)) || null;
  const bitmap = await decodeJpeg(new Uint8Array(message, RESCUE_BYTES));
  return { what: DRAWN, problem: "", rescue: true, bitmap, encoding: "jpeg", key: true, frame: null, capturedMs };
}

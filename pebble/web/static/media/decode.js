// Reads payloads, and decides which pictures may be shown: the rules of pebble/media/decode.py. Pure: it needs no page.

import * as browser from "../core/browser.js";
import { PayloadError } from "./errors.js";
import { MAX_BYTES } from "./jpeg.js";

export const MAX_PAYLOAD = (MAX_BYTES * 3) / 2; // base64 takes a third more
const MAX_TEXT = Math.floor((MAX_BYTES * 4) / 3) + 1024;
const FRAME_LIMIT = 2 ** 32;
const LONGEST_STEP_MS = 5000; // with more time between two pictures the number fits by chance
const MILLISECONDS_FROM = 1e11; // a timestamp as large as this is in milliseconds
const LATEST_MS = 253402300800000; // the year 10000
const HEADER_BYTES = 19;
const MAX_FRAME_NUMBER = 2 ** 53; // of JSON
const H264 = 5;
const KINDS = new Map([
  [1, { encoding: "pbvd", keyframe: true }],
  [2, { encoding: "pbvd", keyframe: false }],
  [3, { encoding: "pbvz", keyframe: true }],
  [4, { encoding: "pbvz", keyframe: false }],
]);

/**
 * @typedef {object} Payload
 * @property {string} encoding json | pbvd | pbvz | h264 | jpeg
 * @property {boolean} keyframe
 * @property {number|null} frame its number; raw JPEG has none
 * @property {number|null} capturedMs epoch time at the sender
 * @property {Uint8Array} body a JPEG, a compressed JPEG, or an access unit
 * @property {boolean} packed whether the body is compressed by zlib
 */

/**
 * The encodings differ in their first bytes. Throws PayloadError for everything else.
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
export function readPayload(bytes) {
  if (bytes.length > MAX_PAYLOAD) throw new PayloadError(`${bytes.length} bytes, more than ${MAX_PAYLOAD}`);
  if (startsWith(bytes, [0x50, 0x42, 0x56, 0x44])) return readPbvd(bytes);
  if (startsWith(bytes, [0xff, 0xd8])) {
    return { encoding: "jpeg", keyframe: true, frame: null, capturedMs: null, body: bytes, packed: false };
  }
  if ([0x7b, 0x20, 0x09, 0x0d, 0x0a].includes(bytes[0])) return readJson(bytes);
  throw new PayloadError("none of the forms of a picture");
}

/**
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
function readPbvd(bytes) {
  if (bytes.length < HEADER_BYTES) throw new PayloadError(`PBVD: ${bytes.length} bytes, less than its header`);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.getUint8(4) !== 1) throw new PayloadError("PBVD: not a packet of version 1");
  const [kind, flags, frame] = [view.getUint8(5), view.getUint8(6), view.getUint32(7)];
  const capturedMs = plausible(Number(view.getBigUint64(11)));
  const body = bytes.subarray(HEADER_BYTES);
  if (kind === H264) return { encoding: "h264", keyframe: (flags & 1) !== 0, frame, capturedMs, body, packed: false };
  const known = KINDS.get(kind);
  if (!known) throw new PayloadError(`PBVD: kind ${kind} is unknown`);
  return { ...known, frame, capturedMs, body, packed: known.encoding === "pbvz" };
}

/**
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
function readJson(bytes) {
  if (bytes.length > MAX_TEXT) throw new PayloadError(`JSON picture: ${bytes.length} bytes`);
  let message;
  try {
    const text = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes);
    message = JSON.parse(text, /** @type {any} */ (whole));
  } catch (error) {
    throw new PayloadError(`JSON picture: ${error}`);
  }
  const { id, keyframe, data, timestamp = null } = message ?? {};
  if (!Number.isInteger(id) || id < 0 || id >= MAX_FRAME_NUMBER) throw new PayloadError("JSON picture: id");
  if (typeof keyframe !== "boolean" || typeof data !== "string") throw new PayloadError("JSON picture: keyframe, data");
  if (timestamp !== null && (typeof timestamp !== "number" || !Number.isFinite(timestamp))) {
    throw new PayloadError("JSON picture: timestamp");
  }
  const capturedMs = milliseconds(timestamp);
  return { encoding: "json", keyframe, frame: id, capturedMs, body: fromBase64(data), packed: true };
}

/**
 * A number that is written as 7.0 is no whole one; browsers that do not show how it is written let it pass.
 * @param {string} name
 * @param {unknown} value
 * @param {{source?: string}} [context]
 */
function whole(name, value, context) {
  return name === "id" && typeof value === "number" && /[.eE]/.test(context?.source ?? "") ? NaN : value;
}

/** @param {string} text */
function fromBase64(text) {
  if (text.length % 4 || !/^[A-Za-z0-9+/]*={0,2}$/.test(text)) throw new PayloadError("JSON picture: base64");
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/**
 * Unpacks the one complete zlib stream in `packed`; throws PayloadError for anything else.
 * The limit matters because a few kilobytes may unpack to gigabytes. zlib ends with a checksum of the content.
 * @param {any} packed bytes
 * @param {number} [limit]
 * @returns {Promise<Uint8Array>}
 */
export async function inflate(packed, limit = MAX_BYTES) {
  const stream = new (browser.find("DecompressionStream"))("deflate");
  const reader = stream.readable.getReader();
  const writer = stream.writable.getWriter();
  const written = writer.write(packed).then(() => writer.close());
  written.catch(() => {}); // the reader fails as well, and reports it
  const parts = [];
  let size = 0;
  try {
    for (let chunk = await reader.read(); !chunk.done; chunk = await reader.read()) {
      size += chunk.value.length;
      if (size > limit) throw new PayloadError(`zlib: unpacks to more than ${limit} bytes`);
      parts.push(chunk.value);
    }
  } catch (error) {
    reader.cancel().catch(() => {});
    throw error instanceof PayloadError ? error : new PayloadError(`zlib: ${error}`);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

/** Which payload may follow which, and what was made of each. */
export class Sequence {
  constructor() {
    /** @type {Payload|null} */
    this.last = null; // null: the next difference builds on nothing
    this.wantsKeyframe = false;
    this.problem = ""; // why the last payload was refused, for display
  }

  /**
   * Whether this payload may be decoded now; if not, a key frame is wanted.
   * @param {Payload} payload
   */
  admit(payload) {
    if (payload.keyframe || this.follows(payload)) return true;
    this.reset();
    return false;
  }

  /** @param {Payload} payload */
  shown(payload) {
    this.last = { ...payload, body: new Uint8Array(0) };
    this.wantsKeyframe = false;
  }

  /**
   * @param {unknown} error
   */
  refuse(error) {
    this.problem = error instanceof Error ? error.message : String(error);
    this.reset();
  }

  reset() {
    this.last = null;
    this.wantsKeyframe = true;
  }

  /** @param {Payload} payload */
  follows(payload) {
    const { last } = this;
    if (last === null || last.encoding !== payload.encoding || payload.frame !== after(last)) return false;
    if (last.capturedMs === null || payload.capturedMs === null) return last.capturedMs === payload.capturedMs;
    const step = payload.capturedMs - last.capturedMs;
    return step >= 0 && step <= LONGEST_STEP_MS;
  }
}

/** @param {Payload} last */
function after(last) {
  if (last.frame === null) return null;
  return last.encoding === "json" ? last.frame + 1 : (last.frame + 1) % FRAME_LIMIT;
}

/** @param {number|null} stamp */
function milliseconds(stamp) {
  if (stamp === null || !(stamp > 0 && stamp < LATEST_MS)) return null;
  return plausible(roundHalfEven(stamp >= MILLISECONDS_FROM ? stamp : stamp * 1000));
}

/** As Python rounds. */
function roundHalfEven(/** @type {number} */ value) {
  const below = Math.floor(value);
  const rest = value - below;
  if (rest !== 0.5) return rest < 0.5 ? below : below + 1;
  return below % 2 ? below + 1 : below;
}

/** @param {number} capturedMs */
function plausible(capturedMs) {
  return capturedMs > 0 && capturedMs < LATEST_MS ? capturedMs : null;
}

/** @param {Uint8Array} bytes @param {number[]} start */
function startsWith(bytes, start) {
  return start.every((value, index) => bytes[index] === value);
}

// Reads payloads, whose headers the server has checked, and decides which pictures may be shown. Pure: it needs no page.

import * as browser from "../core/browser.js";
import { MAX_BYTES } from "./jpeg.js";

const FRAME_LIMIT = 2 ** 32;
const LONGEST_STEP_MS = 5000; // with more time between two pictures the number fits by chance
const MILLISECONDS_FROM = 1e11; // a timestamp as large as this is in milliseconds
const LATEST_MS = 253402300800000; // the year 10000
const HEADER_BYTES = 19;
const H264 = 5;
const KINDS = {
  1: { encoding: "pbvd", keyframe: true },
  2: { encoding: "pbvd", keyframe: false },
  3: { encoding: "pbvz", keyframe: true },
  4: { encoding: "pbvz", keyframe: false },
};

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
 * The encodings differ in their first bytes.
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
export function readPayload(bytes) {
  if (startsWith(bytes, [0x50, 0x42, 0x56, 0x44])) return readPbvd(bytes);
  if (startsWith(bytes, [0xff, 0xd8])) {
    return { encoding: "jpeg", keyframe: true, frame: null, capturedMs: null, body: bytes, packed: false };
  }
  return readJson(bytes);
}

/**
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
function readPbvd(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const [kind, flags, frame] = [view.getUint8(5), view.getUint8(6), view.getUint32(7)];
  const capturedMs = plausible(Number(view.getBigUint64(11)));
  const body = bytes.subarray(HEADER_BYTES);
  if (kind === H264) return { encoding: "h264", keyframe: (flags & 1) !== 0, frame, capturedMs, body, packed: false };
  const { encoding, keyframe } = KINDS[kind];
  return { encoding, keyframe, frame, capturedMs, body, packed: encoding === "pbvz" };
}

/**
 * @param {Uint8Array} bytes
 * @returns {Payload}
 */
function readJson(bytes) {
  const { id, keyframe, data, timestamp = null } = JSON.parse(new TextDecoder().decode(bytes));
  const binary = atob(data);
  const body = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) body[i] = binary.charCodeAt(i);
  return { encoding: "json", keyframe, frame: id, capturedMs: milliseconds(timestamp), body, packed: true };
}

/**
 * Unpacks the one complete zlib stream in `packed`; throws an Error for anything else.
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
      if (size > limit) throw new Error(`unpacks to more than ${limit} bytes`);
      parts.push(chunk.value);
    }
  } catch (error) {
    reader.cancel().catch(() => {});
    throw new Error(`zlib: ${error}`);
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
  return stamp === null ? null : plausible(Math.round(stamp >= MILLISECONDS_FROM ? stamp : stamp * 1000));
}

/** @param {number} capturedMs */
function plausible(capturedMs) {
  return capturedMs > 0 && capturedMs < LATEST_MS ? capturedMs : null;
}

/** @param {Uint8Array} bytes @param {number[]} start */
function startsWith(bytes, start) {
  return start.every((value, index) => bytes[index] === value);
}

// Packets of sound (PBAT) as pebble.extensions.media.sound reads them: the same ones are played, the same ones refused. Pure.

const MAGIC = 0x50424154; // "PBAT"
const HEAD_BYTES = 24;
const [PCM, OPUS] = [1, 2];
const CHANNELS_LIMIT = 8;
const LOWEST_RATE = 4000; // Hz
const OPUS_RATES = [8000, 12000, 16000, 24000, 48000];
const BUNDLE_LIMIT = 3; // Opus packets in one of ours

/**
 * @typedef {object} Sound
 * @property {"pcm"|"opus"} encoding
 * @property {number} rate
 * @property {number} channels
 * @property {number} frames samples of each channel
 * @property {number} sequence
 * @property {number} capturedMs
 * @property {Uint8Array} body
 */

/** @param {Uint8Array} payload @returns {Sound} throws an Error for what cannot be played */
export function unpack(payload) {
  if (payload.length < HEAD_BYTES) throw new Error("less than a header");
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (view.getUint32(0) !== MAGIC || view.getUint8(4) !== 1) throw new Error("no packet of sound");
  const [codec, channels, rate, frames] = [view.getUint8(5), view.getUint8(6), view.getUint16(8), view.getUint16(10)];
  if (!channels || !frames || channels > CHANNELS_LIMIT || rate < LOWEST_RATE || frames > rate) {
    throw new Error(`${frames} samples on ${channels} channels at ${rate} Hz cannot be played`);
  }
  const body = payload.subarray(HEAD_BYTES);
  const sequence = view.getUint32(12);
  const capturedMs = Number(view.getBigUint64(16));
  const sound = { rate, channels, frames, sequence, capturedMs, body };
  if (codec === PCM && body.length >= 2 * frames * channels) return { encoding: "pcm", ...sound };
  if (codec === OPUS && isOpus(sound)) return { encoding: "opus", ...sound };
  throw new Error(`a packet of codec ${codec} is damaged or unknown`);
}

/** @param {Omit<Sound, "encoding">} sound */
function isOpus({ rate, channels, frames, body }) {
  const lasts = split(body).reduce((sum, packet) => sum + milliseconds(packet), 0);
  return OPUS_RATES.includes(rate) && channels <= 2 && frames * 1000 === lasts * rate;
}

/** Interleaved samples of a packet of PCM. @param {Sound} sound @returns {Int16Array} */
export function pcmOf({ body, frames, channels }) {
  const view = new DataView(body.buffer, body.byteOffset, body.byteLength);
  return Int16Array.from({ length: frames * channels }, (_, index) => view.getInt16(2 * index, true));
}

/** The Opus packets of a body, each behind its length. @param {Uint8Array} body @returns {Uint8Array[]} */
export function split(body) {
  const packets = [];
  for (let at = 0; at < body.length; ) {
    const size = at + 2 <= body.length ? (body[at] << 8) | body[at + 1] : 0;
    at += 2 + size;
    if (!size || at > body.length) throw new Error("an Opus packet is empty or cut off");
    packets.push(body.subarray(at - size, at));
  }
  if (!packets.length || packets.length > BUNDLE_LIMIT) throw new Error(`${packets.length} Opus packets in one`);
  return packets;
}

const SILK = [10, 20, 40, 60];
const BOTH = [10, 20];
const CELT = [2.5, 5, 10, 20];

/** How long an Opus packet lasts, by its first bytes (RFC 6716, 3.1 and 3.2). @param {Uint8Array} packet */
export function milliseconds(packet) {
  const mode = packet[0] >> 3;
  const frame = mode < 12 ? SILK[mode % 4] : mode < 16 ? BOTH[mode % 2] : CELT[mode % 4];
  return frame * [1, 2, 2, (packet[1] ?? 0) & 0x3f][packet[0] & 3];
}

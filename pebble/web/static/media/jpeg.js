// Checks that a JPEG is whole before it is decoded: the rules of pebble/media/jpeg.py. Pure.

import { PayloadError } from "./errors.js";

export const MAX_BYTES = 8 << 20;
export const MAX_EDGE = 4096;

const MAX_SEGMENTS = 256;
const MAX_SCANS = 32; // progressive pictures have about ten
const MAX_FILL = 64;
const SIZES = [0xc0, 0xc1, 0xc2]; // baseline, extended and progressive Huffman
const [DHT, JPG, DAC, EOI, SOS, TEM] = [0xc4, 0xc8, 0xcc, 0xd9, 0xda, 0x01];
const [APP1, APP2] = [0xe1, 0xe2]; // EXIF turns pictures, and profiles change colours: neither must happen

/**
 * The size of a complete JPEG, and the JPEG without what would make a browser turn or recolour it.
 * Throws PayloadError unless it is a whole picture.
 * @param {Uint8Array} jpeg
 * @returns {{width: number, height: number, plain: Uint8Array}}
 */
export function checkJpeg(jpeg) {
  if (jpeg.length > MAX_BYTES) throw new PayloadError(`JPEG: ${jpeg.length} bytes, more than ${MAX_BYTES}`);
  if (jpeg[0] !== 0xff || jpeg[1] !== 0xd8) throw new PayloadError("JPEG: no start marker");
  return new Segments(jpeg).check();
}

/** Walks from one marker to the next. */
class Segments {
  /** @param {Uint8Array} jpeg */
  constructor(jpeg) {
    this.jpeg = jpeg;
    this.at = 2;
    this.frame = 0; // which SOF
    this.width = 0;
    this.height = 0;
    this.blocks = 0; // of 8x8 coefficients in the whole picture
    this.scans = 0;
    this.scanned = 0; // bytes in scans
    /** @type {Array<[number, number]>} */
    this.superfluous = []; // from, to
  }

  check() {
    for (let i = 0; i < MAX_SEGMENTS; i++) {
      const start = this.at;
      const marker = this.marker();
      if (marker === EOI) return this.whole();
      const body = this.segment();
      if (marker === APP1 || marker === APP2) this.superfluous.push([start, this.at]);
      if (SIZES.includes(marker)) this.startOfFrame(marker, body);
      else if (marker >= 0xc0 && marker <= 0xcf && ![DHT, JPG, DAC].includes(marker)) {
        throw new PayloadError("JPEG: of an unsupported kind");
      } else if (marker === SOS) this.scan();
    }
    throw new PayloadError("JPEG: too many segments");
  }

  marker() {
    const { jpeg } = this;
    let at = this.at;
    if (jpeg[at] !== 0xff) throw new PayloadError("JPEG: cut short, or no marker where one has to be");
    const fill = at + MAX_FILL;
    while (jpeg[at] === 0xff && at < fill) at++;
    this.at = at + 1;
    const marker = at < jpeg.length ? jpeg[at] : 0;
    if (marker <= TEM || (marker >= 0xd0 && marker <= 0xd8) || marker === 0xff) {
      throw new PayloadError("JPEG: cut short, or a marker where none may be");
    }
    return marker;
  }

  segment() {
    const { jpeg, at } = this;
    const length = at + 1 < jpeg.length ? (jpeg[at] << 8) | jpeg[at + 1] : 0;
    this.at = at + length;
    if (length < 2 || this.at > jpeg.length) throw new PayloadError("JPEG: cut short in a segment");
    return jpeg.subarray(at + 2, this.at);
  }

  /** @param {number} marker @param {Uint8Array} body */
  startOfFrame(marker, body) {
    if (this.frame) throw new PayloadError("JPEG: two pictures in one");
    const colours = body[5];
    if (body.length < 6 || body[0] !== 8 || (colours !== 1 && colours !== 3) || body.length !== 6 + 3 * colours) {
      throw new PayloadError("JPEG: neither grey nor colour of 8 bits");
    }
    const [height, width] = [(body[1] << 8) | body[2], (body[3] << 8) | body[4]];
    if (width < 1 || width > MAX_EDGE || height < 1 || height > MAX_EDGE) {
      throw new PayloadError(`JPEG: ${width}x${height}, larger than ${MAX_EDGE}x${MAX_EDGE} or nothing`);
    }
    [this.frame, this.width, this.height] = [marker, width, height];
    const factors = [];
    for (let i = 7; i < body.length; i += 3) factors.push([body[i] >> 4, body[i] & 15]);
    if (factors.some(([across, down]) => across < 1 || across > 4 || down < 1 || down > 4)) {
      throw new PayloadError("JPEG: impossible sampling");
    }
    const mostAcross = Math.max(...factors.map(([across]) => across));
    const mostDown = Math.max(...factors.map(([, down]) => down));
    for (const [across, down] of factors) {
      this.blocks += eighths(width * across, mostAcross) * eighths(height * down, mostDown);
    }
  }

  scan() {
    this.scans++;
    if (!this.frame || this.scans > MAX_SCANS) throw new PayloadError("JPEG: a scan without a picture, or too many");
    const end = endOfScan(this.jpeg, this.at);
    if (end < 0) throw new PayloadError("JPEG: cut short in its picture");
    this.scanned += end - this.at;
    this.at = end;
  }

  whole() {
    if (!this.scans) throw new PayloadError("JPEG: without a picture");
    // A block takes at least two codes of a bit each, so a scan that is shorter ends before its picture does.
    if (this.frame !== 0xc2 && this.scanned * 4 < this.blocks) {
      throw new PayloadError("JPEG: fewer bytes than a picture of this size takes");
    }
    return { width: this.width, height: this.height, plain: this.plain() };
  }

  plain() {
    if (!this.superfluous.length) return this.jpeg;
    const parts = [];
    let from = 0;
    for (const [start, end] of this.superfluous) {
      parts.push(this.jpeg.subarray(from, start));
      from = end;
    }
    parts.push(this.jpeg.subarray(from));
    return joined(parts);
  }
}

/** Where FF is followed by neither a stuffed zero nor a restart marker; -1 if nowhere. */
function endOfScan(/** @type {Uint8Array} */ jpeg, /** @type {number} */ from) {
  for (let at = jpeg.indexOf(0xff, from); at >= 0 && at + 1 < jpeg.length; at = jpeg.indexOf(0xff, at + 1)) {
    const next = jpeg[at + 1];
    if (next !== 0 && (next < 0xd0 || next > 0xd7)) return at;
  }
  return -1;
}

/** How many blocks of eight hold samples / divisor samples. */
function eighths(/** @type {number} */ samples, /** @type {number} */ divisor) {
  return Math.ceil(samples / (8 * divisor));
}

/**
 * @param {Uint8Array[]} parts
 * @returns {Uint8Array}
 */
export function joined(parts) {
  const whole = new Uint8Array(parts.reduce((length, part) => length + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

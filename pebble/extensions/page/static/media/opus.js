// Packets of Opus to samples, by the browser's decoder.

import * as browser from "../core/browser.js";
import { milliseconds, split } from "./sound-packet.js";

const MOST_PENDING = 32;

/** @returns {Promise<boolean>} false over plain http from another machine, for example */
export async function decodesOpus() {
  if (!browser.find("AudioDecoder")) return false;
  try {
    const config = { codec: "opus", sampleRate: 48000, numberOfChannels: 1 };
    return (await browser.find("AudioDecoder").isConfigSupported(config)).supported === true;
  } catch {
    return false;
  }
}

/** Decodes bundles of Opus packets in the order of their coming. */
export class OpusDecoder {
  /** @param {(packet: import("./jitter.js").Packet) => void} onPacket @param {() => void} onError */
  constructor(onPacket, onError) {
    this.onPacket = onPacket;
    this.onError = onError;
    /** @type {AudioDecoder|null} */
    this.decoder = null;
    this.channels = 0;
    this.at = 0; // microseconds
    /** @type {{sound: import("./sound-packet.js").Sound, left: number, parts: Int16Array[], rate: number}[]} */
    this.pending = [];
  }

  /** @param {import("./sound-packet.js").Sound} sound */
  feed(sound) {
    if (sound.channels !== this.channels || this.pending.length >= MOST_PENDING) this.close();
    const decoder = (this.decoder ??= this.open(sound.channels));
    const packets = split(sound.body);
    this.pending.push({ sound, left: packets.length, parts: [], rate: 0 });
    try {
      for (const data of packets) {
        decoder.decode(new (browser.find("EncodedAudioChunk"))({ type: "key", timestamp: this.at, data }));
        this.at += 1000 * milliseconds(data);
      }
    } catch (error) {
      this.close(); // the next packet begins anew
      throw error;
    }
  }

  close() {
    const { decoder } = this;
    this.decoder = null;
    this.pending = [];
    if (decoder && decoder.state !== "closed") decoder.close();
  }

  /** @param {number} channels */
  open(channels) {
    this.channels = channels;
    /** @type {AudioDecoder} */
    const decoder = new (browser.find("AudioDecoder"))({
      output: (data) => {
        try {
          if (decoder === this.decoder) this.take(data);
        } finally {
          data.close();
        }
      },
      error: () => {
        if (decoder !== this.decoder) return;
        this.close();
        this.onError();
      },
    });
    decoder.configure({ codec: "opus", sampleRate: 48000, numberOfChannels: channels });
    return decoder;
  }

  /** @param {AudioData} data */
  take(data) {
    const [head] = this.pending;
    if (!head) return; // more than was asked for
    head.parts.push(interleaved(data, this.channels));
    head.rate = data.sampleRate;
    if (--head.left) return;
    this.pending.shift();
    const { sequence, capturedMs, channels } = head.sound;
    this.onPacket({ samples: joined(head.parts), rate: head.rate, channels, encoding: "opus", sequence, capturedMs });
  }
}

/** @param {AudioData} data @param {number} channels @returns {Int16Array} */
function interleaved(data, channels) {
  const samples = new Int16Array(data.numberOfFrames * channels);
  const plane = new Float32Array(data.numberOfFrames);
  for (let channel = 0; channel < channels; channel++) {
    data.copyTo(plane, { planeIndex: Math.min(channel, data.numberOfChannels - 1), format: "f32-planar" });
    for (let frame = 0; frame < plane.length; frame++) {
      samples[frame * channels + channel] = Math.max(-32768, Math.min(32767, Math.round(32767 * plane[frame])));
    }
  }
  return samples;
}

/** @param {Int16Array[]} parts */
function joined(parts) {
  const whole = new Int16Array(parts.reduce((length, part) => length + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

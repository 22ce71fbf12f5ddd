/** Reads the answers of /archive/segment: recorded messages, one behind the other. Pure. */

const HEAD_BYTES = 11; // f64 received ms, u8 flags, u16 length of the metric
const LENGTH_BYTES = 4;

/** What the bits of ``flags`` mean. */
export const STATE = 1; // the newest value before the time that was asked for
export const CHAIN = 2; // a picture before that time, which the following ones build on
export const INCOMING = 4; // it was sent to the robot
export const PICTURE = 8;
export const SOUND = 16;

/**
 * One recorded message; ``payload`` shares the memory of the whole answer.
 * @typedef {{at: number, flags: number, metric: string, payload: Uint8Array}} Frame
 */

/**
 * All whole frames from the beginning. ``problem``: what ended the reading before the end; "" nothing did.
 * @param {ArrayBuffer} buffer @returns {{frames: Frame[], problem: string}}
 */
export function readFrames(buffer) {
  const view = new DataView(buffer);
  const text = new TextDecoder();
  /** @type {Frame[]} */
  const frames = [];
  const ended = (problem) => ({ frames, problem: `${problem} at byte ${at} of ${buffer.byteLength}` });
  let at = 0;
  while (at < buffer.byteLength) {
    if (at + LENGTH_BYTES > buffer.byteLength) return ended("the recording's answer is cut short");
    const length = view.getUint32(at);
    const start = at + LENGTH_BYTES;
    if (length < HEAD_BYTES) return ended("a message is damaged");
    if (start + length > buffer.byteLength) return ended("the recording's answer is cut short");
    const receivedMs = view.getFloat64(start);
    const names = view.getUint16(start + 9);
    if (!(receivedMs > 0 && receivedMs < 8.64e15) || HEAD_BYTES + names > length) return ended("a message is damaged");
    const from = start + HEAD_BYTES;
    frames.push({
      at: receivedMs,
      flags: view.getUint8(start + 8),
      metric: text.decode(new Uint8Array(buffer, from, names)),
      payload: new Uint8Array(buffer, from + names, length - HEAD_BYTES - names),
    });
    at = start + length;
  }
  return { frames, problem: "" };
}

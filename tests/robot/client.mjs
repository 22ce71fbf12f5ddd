// A robot's program in another language: the part of MQTT 3.1.1 that this needs, and no code of Pebble's.
// node client.mjs PORT FILTER TOPIC PAYLOAD — subscribes, publishes once (QoS 1), prints what it receives as JSON lines.
import net from "node:net";

const [port, filter, topic, payload] = process.argv.slice(2);
const text = (s) => { const b = Buffer.from(s); return Buffer.concat([Buffer.from([b.length >> 8, b.length & 255]), b]); };

function packet(type, ...parts) {
  const body = Buffer.concat(parts);
  const length = [];
  for (let rest = body.length; ; ) {
    const low = rest & 127;
    rest >>= 7;
    length.push(rest ? low | 128 : low);
    if (!rest) break;
  }
  return Buffer.concat([Buffer.from([type, ...length]), body]);
}

const socket = net.connect(Number(port), "127.0.0.1");
socket.write(packet(0x10, text("MQTT"), Buffer.from([4, 2, 0, 30]), text("a-program-in-javascript")));

let buffer = Buffer.alloc(0);
socket.on("data", (chunk) => {
  buffer = Buffer.concat([buffer, chunk]);
  for (;;) {
    let at = 1, length = 0, shift = 0, byte;
    do {
      if (at >= buffer.length) return;
      byte = buffer[at++];
      length |= (byte & 127) << shift;
      shift += 7;
    } while (byte & 128);
    if (buffer.length < at + length) return;
    handle(buffer[0], buffer.subarray(at, at + length));
    buffer = buffer.subarray(at + length);
  }
});

function handle(head, body) {
  const type = head >> 4;
  if (type === 2) socket.write(packet(0x82, Buffer.from([0, 1]), text(filter), Buffer.from([1])));
  if (type === 9) socket.write(packet(0x32, text(topic), Buffer.from([0, 2]), Buffer.from(payload)));
  if (type !== 3) return;
  const qos = (head >> 1) & 3;
  const size = body.readUInt16BE(0);
  const received = { topic: body.toString("utf8", 2, 2 + size), retain: Boolean(head & 1) };
  if (qos) socket.write(packet(0x40, body.subarray(2 + size, 4 + size)));
  received.payload = body.toString("utf8", 2 + size + (qos ? 2 : 0));
  console.log(JSON.stringify(received));
}

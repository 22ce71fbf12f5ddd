// One connection, on a thread: its pieces in hexadecimal digits, an empty one once it is connected, null at its end.
import net from "node:net";
import tls from "node:tls";
import { workerData } from "node:worker_threads";

const { port, host, number, ca, bell } = workerData;
const socket = ca ? tls.connect({ host, port: number, ca }) : net.connect(number, host);
const tell = (what) => {
  port.postMessage(what);
  Atomics.store(bell, 0, 1);
  Atomics.notify(bell, 0);
};
socket.setNoDelay(true);
socket.on(ca ? "secureConnect" : "connect", () => tell(""));
socket.on("data", (data) => tell(data.toString("hex")));
socket.on("error", () => {}); // its end follows
socket.on("close", () => (tell(null), port.close()));
port.on("message", (hex) => (hex === null ? socket.destroy() : socket.write(Buffer.from(hex, "hex"))));

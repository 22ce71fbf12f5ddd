// Runs the sample for a board in the real MicroPython, with the network and the flash of this machine:
//     node run.mjs MICROPYTHON PROGRAM ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
// MicroPython never returns to Node's loop, so sockets live on a thread of their own, and are read by messages from there.
import { randomBytes } from "node:crypto";
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { MessageChannel, Worker, receiveMessageOnPort } from "node:worker_threads";

const [folder, program, ID, HOST, PORT, STOP_FILE, ...login] = process.argv.slice(2);
const [user, password, ca] = login.map((given, at) => (at === 0 ? given : fs.readFileSync(given, "utf8").trim()));
const settings = { WIFI: "", WIFI_PASSWORD: "", ID, HOST, PORT: Number(PORT), STOP_FILE, LOGIN: user ? [user, password, ca] : [] };
const { loadMicroPython } = await import(pathToFileURL(`${folder}/micropython.mjs`));
const board = new URL("board/", import.meta.url);
const bell = new Int32Array(new SharedArrayBuffer(4)); // rung for each message from a socket
let port = null, pieces = [], ended = false; // of the connection

function dial(host, number, ca) {
  const { port1, port2 } = new MessageChannel();
  [port, pieces, ended] = [port1, [], false];
  new Worker(new URL("socket.mjs", import.meta.url), { workerData: { port: port2, host, number, ca, bell }, transferList: [port2] });
  while (pieces.length === 0 && !ended) wait(100), take();
  pieces.shift(); // an empty piece: it is connected
  return !ended;
}

function take() {
  for (let message; port && (message = receiveMessageOnPort(port)); ) message.message === null ? (ended = true) : pieces.push(message.message);
  return pieces.length > 0 || ended;
}

function wait(ms) {
  Atomics.wait(bell, 0, 0, ms);
  Atomics.store(bell, 0, 0);
}

const host = {
  dial,
  wait: (ms) => (take() || wait(ms), take()),
  read: () => (take(), pieces.length > 0 ? pieces.shift() : ended ? "" : "-"),
  write: (hex) => void port?.postMessage(hex),
  random: (size) => randomBytes(size).toString("hex"),
  close: () => void port?.postMessage(null),
};
const mp = await loadMicroPython({ heapsize: 1 << 20, url: `${folder}/micropython.wasm`, linebuffer: true,
  stdout: (text) => console.log(text) });
mp.registerJsModule("host", host);
mp.FS.mkdirTree("/lib");
for (const from of [board, pathToFileURL(`${path.dirname(program)}/`)]) {
  for (const name of fs.readdirSync(from).filter((name) => name.endsWith(".py"))) mp.FS.writeFile(`/lib/${name}`, fs.readFileSync(new URL(name, from)));
}
mp.FS.writeFile("/lib/settings.py", Object.entries(settings).map(([name, value]) => `${name} = ${JSON.stringify(value)}\n`).join(""));
mp.FS.mkdirTree(path.dirname(STOP_FILE)); // the flash: what replaces a file there is on the disk here
if (fs.existsSync(STOP_FILE)) mp.FS.writeFile(STOP_FILE, fs.readFileSync(STOP_FILE));
const rename = mp.FS.rename;
mp.FS.rename = (from, to) => {
  rename(from, to);
  fs.writeFileSync(`${to}.saved`, mp.FS.readFile(to), { flush: true });
  fs.renameSync(`${to}.saved`, to);
};
mp.runPython("import binascii, host, os\nos.urandom = lambda size: binascii.unhexlify(host.random(size))"); // boards have it
mp.runPython(fs.readFileSync(program, "utf8"));
process.exit(0);

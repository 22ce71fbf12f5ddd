// Runs a sample for a board in the real MicroPython, with the network, the flash and the console of this machine:
//     node run.mjs MICROPYTHON MQTT_PY PROGRAM ID HOST PORT [STOP_FILE] [USER PASSWORD_FILE CA_FILE]
// MicroPython never returns to Node's loop, so sockets live on a thread of their own, and are read by messages from there.
import { randomBytes } from "node:crypto";
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { MessageChannel, Worker, receiveMessageOnPort } from "node:worker_threads";

const [folder, mqtt, program, ID, HOST, PORT, ...more] = process.argv.slice(2);
const STOP_FILE = path.basename(program).startsWith("robot") ? more.shift() : "";
const [user, password, ca] = more.map((given, at) => (at === 0 ? given : fs.readFileSync(given, "utf8").trim()));
const settings = { WIFI: "", WIFI_PASSWORD: "", ID, HOST, PORT: Number(PORT), STOP_FILE, LOGIN: user ? [user, password, ca] : [] };
const { loadMicroPython } = await import(pathToFileURL(`${folder}/micropython.mjs`));
const board = new URL("board/", import.meta.url);
const bell = new Int32Array(new SharedArrayBuffer(4)); // rung for each message from a socket
const console_ = fs.openSync("/dev/stdin", fs.constants.O_RDONLY | fs.constants.O_NONBLOCK);
let port = null, pieces = [], ended = false; // of the connection
let line = [], over = false; // what was typed, and its end

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

function readConsole() {
  const bytes = Buffer.alloc(4096);
  try {
    const size = fs.readSync(console_, bytes);
    size > 0 ? line.push(...bytes.subarray(0, size)) : (over = true);
  } catch (error) {
    if (error.code !== "EAGAIN") throw error;
  }
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
  typed: () => {
    if (line.length === 0 && !over) readConsole();
    return line.length > 0 || over;
  },
};
const mp = await loadMicroPython({ heapsize: 1 << 20, url: `${folder}/micropython.wasm`, linebuffer: true,
  stdout: (text) => console.log(text), stdin: () => line.shift() ?? null });
mp.registerJsModule("host", host);
mp.FS.mkdirTree("/lib");
for (const file of [...fs.readdirSync(board).map((name) => new URL(name, board)), mqtt])
  mp.FS.writeFile(`/lib/${path.basename(file.pathname ?? file)}`, fs.readFileSync(file));
mp.FS.writeFile("/lib/settings.py", Object.entries(settings).map(([name, value]) => `${name} = ${JSON.stringify(value)}\n`).join(""));
if (STOP_FILE) {
  mp.FS.mkdirTree(path.dirname(STOP_FILE)); // the flash: what replaces a file there is on the disk here
  if (fs.existsSync(STOP_FILE)) mp.FS.writeFile(STOP_FILE, fs.readFileSync(STOP_FILE));
  const rename = mp.FS.rename;
  mp.FS.rename = (from, to) => {
    rename(from, to);
    fs.writeFileSync(`${to}.saved`, mp.FS.readFile(to), { flush: true });
    fs.renameSync(`${to}.saved`, to);
  };
}
mp.runPython("import binascii, host, os\nos.urandom = lambda size: binascii.unhexlify(host.random(size))"); // boards have it
mp.runPython(fs.readFileSync(program, "utf8"));
process.exit(0);

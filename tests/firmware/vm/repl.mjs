// MicroPython with its REPL on stdin and stdout: a board without hardware, for tools that talk to one.
//     node repl.mjs FOLDER_OF_MICROPYTHON [rom]
// With "rom" it has flash from which code runs in place, as some images for real boards.
// As on a board, a soft reset (Ctrl-D) empties the heap and keeps the files; after machine.reset() /main.py starts.
// Raw paste is answered with "not here",
// which the protocol provides for: this build cannot wait for input in the middle of a read.
import fs from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, rom] = process.argv.slice(2);
const { loadMicroPython } = await import(pathToFileURL(`${folder}/micropython.mjs`));
const [CTRL_A, CTRL_B, CTRL_E] = [1, 2, 5];
const DISK = "/board"; // as flash_disk.py expects
const BOOT = fs.readFileSync(new URL("flash_disk.py", import.meta.url), "utf8");

async function boot(image) {
  const mp = await loadMicroPython({
    romfs: image?.[0] === 0xd2 ? image : undefined, // the format's first byte: erased flash has another
    heapsize: 64 * 1024,
    url: `${folder}/micropython.wasm`,
    linebuffer: false,
    stdout: (data) => process.stdout.write(data),
  });
  mp.registerJsModule("machine", { reset: () => { resetting = true; } });
  mp.FS.mkdir(DISK);
  mp.FS.writeFile("/rom.img", image ?? new Uint8Array(16 * 4096).fill(0xff));
  mp.runPython(`ROM = ${rom ? "True" : "False"}\n${BOOT}`);
  return mp;
}

function copyFiles(from, to, folder) {
  for (const name of from.FS.readdir(folder)) {
    if (name === "." || name === "..") continue;
    const path = `${folder}/${name}`;
    if (from.FS.isDir(from.FS.stat(path).mode)) {
      to.FS.mkdir(path);
      copyFiles(from, to, path);
    } else {
      to.FS.writeFile(path, from.FS.readFile(path));
    }
  }
}

let resetting = false;
let raw = false;
let mp = await boot();
mp.replInit();
let paste = 0; // bytes to come of "raw paste, please" after its Ctrl-E

async function restart() {
  const fresh = await boot(mp.FS.readFile("/rom.img"));
  copyFiles(mp, fresh, DISK);
  mp = fresh;
}

async function softReset() {
  process.stdout.write("MPY: soft reboot\r\n");
  await restart();
  mp.replInit();
  if (raw) await mp.replProcessCharWithAsyncify(CTRL_A);
}

async function hardReset() {
  await restart();
  resetting = raw = false;
  try {
    if (mp.FS.analyzePath(`${DISK}/main.py`).exists) mp.runPython("import main");
  } catch (error) {
    process.stdout.write(error.message);
  }
  mp.replInit();
}

async function take(byte) {
  if (paste > 0) {
    if (--paste === 0) process.stdout.write("R\x00");
    return;
  }
  if (raw && byte === CTRL_E) {
    paste = 2;
    return;
  }
  if (byte === CTRL_A) raw = true;
  if (byte === CTRL_B) raw = false;
  const ended = await mp.replProcessCharWithAsyncify(byte);
  if (resetting) await hardReset();
  else if (ended) await softReset();
}

let line = Promise.resolve();
process.stdin.on("data", (data) => {
  for (const byte of data) line = line.then(() => take(byte));
});

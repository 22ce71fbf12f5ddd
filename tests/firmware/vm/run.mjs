// Runs one script in MicroPython, with a folder of the host as its file system; its output is ours, and so is its fate.
//     node run.mjs FOLDER_OF_MICROPYTHON ROOT SCRIPT HEAP [cap]
// HEAP: bytes to start with; it grows as needed, or with "cap" not at all: then MemoryError as on a board.
// A file rom.romfs in ROOT is flash from which code runs in place, mounted at /rom.
// This build collects garbage only between calls from JavaScript. A script that defines turn() is called again and again
// until it returns false, so that gc.collect() inside it means something.
import fs from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, root, script, heap, cap] = process.argv.slice(2);
const { loadMicroPython } = await import(pathToFileURL(`${folder}/micropython.mjs`));
const rom = `${root}/rom.romfs`;
const mp = await loadMicroPython({
  romfs: fs.existsSync(rom) ? fs.readFileSync(rom) : undefined,
  heapsize: Number(heap),
  url: `${folder}/micropython.wasm`,
  linebuffer: true,
  stdout: (line) => console.log(line),
});

function copy(from, to) {
  for (const entry of fs.readdirSync(from, { withFileTypes: true })) {
    if (entry.isDirectory()) {
      mp.FS.mkdir(`${to}/${entry.name}`);
      copy(`${from}/${entry.name}`, `${to}/${entry.name}`);
    } else {
      mp.FS.writeFile(`${to}/${entry.name}`, fs.readFileSync(`${from}/${entry.name}`));
    }
  }
}

// What would become more heap is taken away: memory cannot grow, and of what there is only crumbs are left, too small
// for a piece of heap (py/gc.c: at least 2048 bytes), big enough for what JavaScript hands over.
function capHeap() {
  const error = console.error;
  WebAssembly.Memory.prototype.grow = () => { throw new RangeError("no more memory on this board"); };
  console.error = () => {}; // Emscripten's report of it
  for (let size = 1 << 24; size >= 2048; size >>= 1) while (mp._module._malloc(size));
  console.error = error;
}

copy(root, "");
const source = fs.readFileSync(script, "utf8");
if (cap) capHeap();
try {
  mp.runPython(source);
  const turn = mp.globals.get("turn");
  if (turn) while (turn());
} catch (error) {
  console.log(error.message);
  process.exitCode = 1;
}

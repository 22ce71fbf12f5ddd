// Runs one script in MicroPython, with a folder of the host as its file system; its output is ours, and so is its fate.
//     node run.mjs FOLDER_OF_MICROPYTHON ROOT SCRIPT HEAP
// HEAP: bytes to start with; it grows as needed.
// A file rom.romfs in ROOT is flash from which code runs in place, mounted at /rom.
// This build collects garbage only between calls from JavaScript. A script that defines turn() is called again and again
// until it returns false, so that gc.collect() inside it means something.
import fs from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, root, script, heap] = process.argv.slice(2);
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

copy(root, "");
const source = fs.readFileSync(script, "utf8");
try {
  mp.runPython(source);
  const turn = mp.globals.get("turn");
  if (turn) while (turn());
} catch (error) {
  console.log(error.message);
  process.exitCode = 1;
}

// Recordings as @mcap/core reads them, all checksums compared: node mcap_core.cjs FILE … prints a line for each file, with
// the messages of its statistics, those found by its index, and those found from its beginning to its end.
"use strict";
const fs = require("node:fs");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { decompress } = require("fzstd");

const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };

async function counted(file) {
  const data = fs.readFileSync(file);
  const readable = {
    size: async () => BigInt(data.length),
    read: async (offset, size) => new Uint8Array(data.buffer, data.byteOffset + Number(offset), Number(size)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  let indexed = 0;
  for await (const _ of reader.readMessages({ validateCrcs: true })) indexed += 1;
  const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  stream.append(data);
  let streamed = 0;
  for (let record; (record = stream.nextRecord()); ) streamed += record.type === "Message";
  if (!stream.done()) throw new Error(`${file}: it does not end as a recording does`);
  return [Number(reader.statistics.messageCount), indexed, streamed];
}

(async () => {
  for (const file of process.argv.slice(2)) console.log((await counted(file)).join(" "));
})();

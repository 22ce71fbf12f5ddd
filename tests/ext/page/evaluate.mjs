// Runs one module after another, each in a thread of its own, since to start Node.js takes 20 times as long.
// In: a line of JSON for each, its source. Out: a line of JSON, what it has sent to its parent, or its error.

import { createInterface } from "node:readline";
import { Worker } from "node:worker_threads";

for await (const line of createInterface({ input: process.stdin })) {
  const url = new URL(`data:text/javascript,${encodeURIComponent(JSON.parse(line))}`);
  const worker = new Worker(url, { stdout: true });
  const answer = await new Promise((resolve) => {
    worker.on("message", (value) => resolve({ value }));
    worker.on("error", (error) => resolve({ error: String(error?.stack ?? error) }));
    worker.on("exit", () => resolve({ error: "it ended without a result" }));
  });
  await worker.terminate();
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}

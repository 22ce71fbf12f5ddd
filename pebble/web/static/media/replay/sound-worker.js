// The worker of sound.js: recorded packets in, samples to the loudspeaker.

import { Playout } from "../playout.js";

const STATS_MS = 250;

/** @type {Playout | null} */
let playout = null;

self.onmessage = ({ data }) => {
  if (data.op === "begin") begin(data.port, data.rate);
  else playout?.take(data.payload);
};

/** @param {MessagePort} port @param {number} rate */
function begin(port, rate) {
  playout?.port.close();
  playout?.opus.close();
  playout = new Playout(port, rate);
}

setInterval(() => playout && self.postMessage({ stats: playout.stats() }), STATS_MS);

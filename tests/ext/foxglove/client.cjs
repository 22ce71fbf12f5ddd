// Foxglove's own client: node client.cjs ADDRESS TOPIC COUNT prints what it has received of a topic, as one JSON object.
"use strict";
const { default: FoxgloveClient } = require("@foxglove/ws-protocol/dist/cjs/src/FoxgloveClient.js");
const { WebSocket } = require("ws");

const [address, topic, count] = process.argv.slice(2);
const client = new FoxgloveClient({ ws: new WebSocket(address, ["foxglove.sdk.v1"]) });
const seen = { messages: [], topics: [] };
let subscription;
client.on("error", (error) => { throw error; });
client.on("serverInfo", (info) => { seen.info = info; });
client.on("advertise", (channels) => {
  seen.topics.push(...channels.map((channel) => channel.topic));
  const channel = channels.find((one) => one.topic === topic);
  if (channel && subscription === undefined) {
    seen.channel = channel;
    subscription = client.subscribe(channel.id);
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  if (subscriptionId !== subscription) throw new Error(`a message of subscription ${subscriptionId}`);
  seen.messages.push({ at: String(timestamp), data: Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64") });
  if (seen.messages.length === Number(count)) {
    client.unsubscribe(subscription);
    client.close();
    process.stdout.write(JSON.stringify(seen));
  }
});

// Drives a robot by the lines that a person types. It needs Node.js, npm's mqtt, and the modules beside it.
//
//     node operator.mjs ID HOST PORT [USER PASSWORD_FILE CA_FILE]
//
// "0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" or an empty line lets go, "stop" and "reset" are the
// emergency stop, Ctrl-D ends it. With a user, commands carry this name.
import { randomBytes } from "node:crypto";
import fs from "node:fs";
import readline from "node:readline";
import mqtt from "mqtt";
import { Driver } from "./driver.mjs";
import { METRICS, RobotState } from "./robot-state.mjs";

const [ID, HOST, PORT, USER, PASSWORD_FILE, CA_FILE] = process.argv.slice(2);
const NAME = USER ?? "sample";
const OUTGOING = `pebble/robots/${ID}/outgoing/`;
const PLAIN = `pebble/robots/${ID}/incoming/`;
const INCOMING = USER === undefined ? PLAIN : `${PLAIN}by/${USER}/`;
const STEP_MS = 10;
const REPEATS_MS = 500;
const GIVES_UP_MS = 60_000;

process.stdout._handle?.setBlocking?.(false); // a terminal that stands still must delay no stop
const robot = new RobotState();
const driver = new Driver(robot, NAME, send);
let stop = null; // an emergency stop that is not confirmed yet

const client = mqtt.connect({
  protocol: USER === undefined ? "mqtt" : "mqtts", // mqtts: with TLS
  host: HOST,
  port: Number(PORT),
  ca: USER === undefined ? undefined : fs.readFileSync(CA_FILE),
  protocolVersion: 4, // MQTT 3.1.1
  clientId: `operator-${driver.id}`,
  username: USER,
  password: USER === undefined ? undefined : fs.readFileSync(PASSWORD_FILE, "utf8").trim(),
  keepalive: 5, // seconds
  reconnectPeriod: 500, // milliseconds
  resubscribe: false, // it is done at each connection, below
  queueQoSZero: false, // what waited would come late
});
client.on("connect", () => {
  client.subscribe(METRICS.map((metric) => OUTGOING + metric), { qos: 1 });
});
client.on("message", (topic, payload, packet) => {
  robot.receive(topic.slice(OUTGOING.length), payload, packet.retain);
});
client.on("close", () => robot.disconnect());
client.on("error", (error) => console.log(error.message)); // it tries again

readline
  .createInterface({ input: process.stdin })
  .on("line", (line) => obey(line.trim()))
  .on("close", end);
process.on("SIGINT", end); // Ctrl-C lets go as well
const steps = setInterval(step, STEP_MS);

/** Publish a command, never retained: it would be carried out at every start of the robot. */
function send(metric, value, qos, base = INCOMING) {
  if (client.connected) {
    client.publish(base + metric, JSON.stringify(value), { qos });
  }
}

function obey(line) {
  if (line === "stop") {
    const name = randomBytes(8).toString("hex");
    stop = { command: { stop: name, by: NAME }, dueAt: 0, endsAt: performance.now() + GIVES_UP_MS };
  } else if (line === "reset") {
    reset();
  } else {
    const [x, z] = line.split(/\s+/).map(Number);
    driver.push(x, z);
  }
}

/** End the stops that are shown now, and no later one. */
function reset() {
  for (const { boot, count } of robot.known(robot.stops).values()) {
    send("estop-reset", { boot, count }, 1);
  }
}

function step() {
  const now = performance.now();
  if (stop !== null && (robot.hasStop(stop.command.stop) || now > stop.endsAt)) {
    console.log(robot.hasStop(stop.command.stop) ? "the robot is stopped" : "the stop is not confirmed");
    stop = null;
  }
  if (stop !== null && now >= stop.dueAt) {
    stop.dueAt = now + REPEATS_MS;
    for (const base of new Set([PLAIN, INCOMING])) {
      send("estop", stop.command, 1, base); // a stop counts without a name as well
    }
  }
  driver.step(stop !== null);
}

function end() {
  clearInterval(steps); // else it would ask for control again
  driver.push(0, 0);
  driver.release();
  setTimeout(() => process.exit(), 300); // until this is sent
}

// The smallest honest operator, with Node.js and npm's mqtt:  operator.mjs ID HOST PORT [USER PASSWORD_FILE CA_FILE]
// Each line of standard input is a command: "0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" lets go,
// "stop" and "reset" are the emergency stop; at its end control is released. With a user its commands bear this name.
import { randomBytes } from "node:crypto";
import fs from "node:fs";
import net from "node:net";
import readline from "node:readline";
import tls from "node:tls";
import mqtt from "mqtt";

const [ID, HOST, PORT, USER, PASSWORD_FILE, CA_FILE] = process.argv.slice(2);
const PLAIN = `pebble/robots/${ID}/incoming/`, OUT = `pebble/robots/${ID}/outgoing/`, BY = USER ?? "sample";
const IN = USER === undefined ? PLAIN : `${PLAIN}by/${USER}/`;
const SILENT_MS = { wide: 1500, narrow: 3000, thin: 5000 }, WIDE = { level: "wide", drive_hz: 20 };
const LETS_GO_MS = 3000, REPEATS_MS = 500, GIVES_UP_MS = 60_000;
const now = () => performance.now(), clamp = (value, least, most) => Math.max(least, Math.min(most, value));
const ms = () => Math.floor(now()); // of a clock that is never set
const id = randomBytes(4).toString("hex");
let stick = [0, 0], moves = false, blocked = false; // blocked: until the stick is let go
let seen = -Infinity, offline = true, capabilities = {}, link = WIDE;
const stops = new Map(), states = new Map(); // of all motor owners, by the name of the owner
let drivesAt = -Infinity, asksAt = -Infinity, movedAt = -Infinity;
let pressed = null; // an emergency stop that is not confirmed: its name, and from when to when it is repeated

function send(metric, value, qos = 1, base = IN) {
  if (client.connected) client.publish(base + metric, JSON.stringify(value), { qos }); // else it would come late
}

const pushed = () => stick.some((one) => one !== 0);
const controlled = () => capabilities.drive?.control === true;

/** It has the keys of all owners; the first owner by name decides who drives. */
function key() {
  const own = [...states].sort(([a], [b]) => (a < b ? -1 : 1)).map(([, one]) => (one.id === id && one.key) || "");
  return own[0] ? own.filter(Boolean).join(" ") : "";
}

/** Why nothing may move; empty if it may. */
function whyNot() {
  if (offline || now() > seen + (SILENT_MS[link.level] ?? 1500)) return "the robot is silent";
  if (pressed || [...stops.values()].some((one) => one.latched !== false)) return "the robot is stopped";
  return blocked ? "let go first" : "";
}

/** The stick is here now; what is no number lets it go. */
function push(x, z) {
  stick = Number.isFinite(x) && Number.isFinite(z) ? [clamp(x, -1, 1), clamp(z, -1, 1)] : [0, 0];
  if (pushed()) return;
  blocked = moves = false;
  send("drive-values", { x: 0, z: 0, ...(key() && { key: key() }) });
}

/** Often enough for the wheels to turn on, and no more often than the link carries. */
function drive() {
  if (pushed() && (whyNot() || (moves && controlled() && !key()))) {
    [blocked, moves] = [true, false]; // who holds the stick down must not drive on later
  }
  if (pushed() && !whyNot()) movedAt = now();
  if (controlled() && now() >= asksAt && now() < movedAt + LETS_GO_MS) {
    asksAt = now() + 1000;
    request("hold");
  } else if (key() && now() > movedAt + LETS_GO_MS) {
    request("release");
    states.clear();
  }
  if (!pushed() || whyNot() || (controlled() && !key()) || now() < drivesAt) return;
  const wide = link.level === "wide";
  drivesAt = Math.max(drivesAt, now() - 100) + 1000 / clamp(link.drive_hz, 2, 20);
  const command = { x: stick[0], z: stick[1], valid_ms: wide ? 400 : 750 };
  send("drive-values", key() ? { ...command, key: key(), t: ms() } : command, wide ? 1 : 0);
  moves = true;
}

function request(want) {
  const value = { id, want, for_ms: 3000, by: BY, device: "sample" };
  send("control", link.level === "wide" ? value : { ...value, for_ms: 10_000, t: ms() });
}

function press() {
  pressed = { stop: { stop: randomBytes(8).toString("hex"), by: BY }, at: now(), end: now() + GIVES_UP_MS };
}

/** An emergency stop is repeated until every owner has its name, or a minute has gone by. */
function repeatStop() {
  const { stop, at, end } = pressed, listed = capabilities.estop?.owners;
  const owners = Array.isArray(listed) ? listed : [...stops.keys()];
  const confirmed = owners.length > 0 && owners.every((one) => stops.get(one)?.recent?.includes(stop.stop));
  if (confirmed || now() > end) pressed = null;
  else if (now() >= at) {
    pressed.at = now() + REPEATS_MS;
    for (const base of new Set([PLAIN, IN])) send("estop", stop, 1, base); // a stop needs no name
  }
}

/** End the stops that are shown now, and no later one. */
function reset() {
  for (const { boot, count } of stops.values()) send("estop-reset", { boot, count });
}

function receive(topic, payload, packet) {
  const [metric, owner] = topic.slice(OUT.length).split("/");
  try {
    const value = payload.length > 0 ? JSON.parse(payload) : {};
    if (metric === "online" && !packet.retain) [seen, offline] = [now(), value.online === false];
    else if (metric === "capabilities") capabilities = { ...value.value };
    else if (metric === "link") link = Number.isFinite(value.drive_hz) ? { ...WIDE, ...value } : WIDE;
    else if (metric === "estop") stops.set(owner, { ...value });
    else if (metric === "control") {
      states.set(owner, { ...value });
      if (value.asks) console.log(`${value.asks} asks for control`);
    }
  } catch {} // what cannot be read changes nothing
}

function line(text) {
  if (text === "stop") press();
  else if (text === "reset") reset();
  else push(...`${text} 0 0`.trim().split(/\s+/).slice(0, 2).map(Number));
}

const ca = USER === undefined ? undefined : fs.readFileSync(CA_FILE);
const dial = () => (ca ? tls.connect({ port: PORT, host: HOST, ca }) : net.connect(PORT, HOST));
const password = ca && fs.readFileSync(PASSWORD_FILE, "utf8").trim();
const client = new mqtt.MqttClient(dial, {
  protocolVersion: 4, keepalive: 5, reconnectPeriod: 500, resubscribe: false, queueQoSZero: false, username: USER, password,
  clientId: `operator-${id}`,
});
client.on("error", () => {}); // it tries again
client.on("message", receive);
client.on("close", () => (states.clear(), (offline = true)));
client.on("connect", () => {
  client.subscribe(["online", "capabilities", "link", "estop/+", "control/+"].map((one) => OUT + one), { qos: 1 });
});
setInterval(() => (drive(), pressed && repeatStop()), 10);
readline.createInterface({ input: process.stdin }).on("line", (text) => line(text.trim())).on("close", () => {
  push(0, 0), request("release");
  setTimeout(() => process.exit(), 300);
});

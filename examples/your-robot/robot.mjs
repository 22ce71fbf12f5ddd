// The smallest honest robot, with Node.js and npm's mqtt:  robot.mjs ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
// With a user it is at level named: only what has the sender's account in its topic moves it, or ends a stop.
import { randomBytes } from "node:crypto";
import fs from "node:fs";
import net from "node:net";
import tls from "node:tls";
import mqtt from "mqtt";

const [ID, HOST, PORT, STOP_FILE, USER, PASSWORD_FILE, CA_FILE] = process.argv.slice(2);
const NAMED = USER !== undefined, IN = `pebble/robots/${ID}/incoming/`, OUT = `pebble/robots/${ID}/outgoing/`;
const OWNER = "motors", DEAD_MAN_MS = 750, PAUSE_MS = 500, LONGEST = 512;
const CAPABILITIES = {
  identity: { system: "pebble", type: "robots", id: ID },
  drive: { available: true, controls: true, control: true },
  estop: { available: true, owners: [OWNER] },
  named: NAMED,
};
const NOBODY = { id: "", by: "", device: "", key: "" }, UNASKED = { asks: "", asks_id: "" };
const now = () => performance.now(), clamp = (value, least, most) => Math.max(least, Math.min(most, value));
const text = (value) => (typeof value === "string" ? value : "");
const boot = randomBytes(4).toString("hex");
let count = 0, refused = null, pausedAt = -Infinity, saved = false;
let holder = NOBODY, lease = { account: "", forMs: 0, ends: 0 }; // who drives, and until when
let asker = UNASKED, asksUntil = 0; // who waits for control
let until = 0, wheels = [0, 0], shown = ""; // when the wheels stop, and what they do
let stop = { latched: fs.existsSync(STOP_FILE), recent: [], by: "", why: "", since: 0 };
try {
  if (stop.latched) stop = { ...stop, ...JSON.parse(fs.readFileSync(STOP_FILE, "utf8")) };
} catch {
  stop.why = "the saved state cannot be read";
}

function publish(metric, value, qos = 1) {
  client.publish(OUT + metric, JSON.stringify(value), { qos, retain: true });
}

function publishStop() {
  try {
    if (!saved) fs.writeFileSync(STOP_FILE + ".new", JSON.stringify(stop), { flush: true });
    if (!saved) fs.renameSync(STOP_FILE + ".new", STOP_FILE);
    [saved, pausedAt] = [true, saved ? pausedAt : now()]; // what came meanwhile moves nothing
  } catch {} // it is tried again
  publish(`estop/${OWNER}`, { ...stop, boot, count, reset_refused: refused, persisted: saved });
}

/** Motors get this, and nothing after so many milliseconds: here they are shown, a real robot sets its pins. */
function turn(left, right, ms) {
  [wheels, until] = [[left, right], now() + ms];
  if (String(wheels) !== shown) publish("status", { t: Date.now(), value: { wheels } });
  shown = String(wheels);
}

function drive({ x = 0, z = 0, key, valid_ms = DEAD_MAN_MS }, account) {
  if (!Number.isFinite(x) || !Number.isFinite(z) || !Number.isFinite(valid_ms)) return; // NaN is no speed
  [x, z] = [clamp(x, -1, 1), clamp(z, -1, 1)];
  const mine = holder.key !== "" && key === holder.key && account === lease.account;
  if (mine) lease.ends = Math.max(lease.ends, now() + lease.forMs);
  if (x === 0 && z === 0) {
    turn(0, 0, 0);
    if (mine || holder.key === "") pausedAt = -Infinity; // who lets go after a reset may drive again
  } else if (now() < pausedAt + PAUSE_MS) {
    pausedAt = now(); // a stick that is held down moves nothing
  } else if (!stop.latched && (mine || (key === undefined && !NAMED))) {
    turn(clamp(z + x, -1, 1), clamp(z - x, -1, 1), clamp(valid_ms, 0, DEAD_MAN_MS));
  }
}

/** Whatever arrives here is a stop; what has a name counts once. */
function halt(payload, account) {
  turn(0, 0, 0);
  let told = {};
  try {
    told = JSON.parse(payload) ?? {};
  } catch {} // it is one, all the same
  const name = /^[0-9a-f]{16}$/.test(text(told.stop)) ? told.stop : randomBytes(8).toString("hex");
  if (!stop.recent.includes(name)) {
    [count, refused, saved] = [count + 1, null, false];
    const [by, why] = [told.by, told.why].map((one) => text(one).replace(/[^ !#-[\]-~]/g, "_"));
    stop = { latched: true, recent: [name, ...stop.recent].slice(0, 8), why: why.slice(0, 40), since: Date.now() };
    stop.by = account.slice(0, 32) || by.slice(0, 31) + (NAMED ? "?" : ""); // a name that no broker has checked
  }
  setTimeout(publishStop, 20); // saving may take a while: first it is published that the wheels stand
}

/** End the stop that its sender has seen, and no other. */
function reset(command) {
  refused = command.boot !== boot ? "boot" : command.count !== count ? "count" : null;
  if (refused === null && stop.latched) [stop, saved, pausedAt] = [{ ...stop, latched: false }, false, now()];
  publishStop();
}

/** Who has control keeps it until it ends, is released or taken. Who asks meanwhile is shown. */
function control({ id, want, for_ms = 3000, by = "", device = "" }, account, take) {
  if (!/^[0-9A-Fa-f]{8}$/.test(text(id)) || !Number.isFinite(for_ms)) return;
  const mine = id === holder.id && account === lease.account, forMs = clamp(for_ms, 1000, 10_000);
  const [who, what] = [by, device].map((one) => text(one).replace(/[^a-z0-9_/-]/g, "_"));
  const asks = [account, who].filter(Boolean).join("/").slice(0, 40);
  if (want === "release") return passOn(mine ? NOBODY : holder);
  if (take || mine || holder.key === "") {
    lease = { account, forMs, ends: now() + forMs };
    return passOn(mine ? holder : { id, by: asks, device: what.slice(0, 20), key: randomBytes(4).toString("hex") });
  }
  if (["", id].includes(asker.asks_id)) [asker, asksUntil] = [{ asks, asks_id: id }, now() + forMs];
  passOn(holder);
}

function passOn(to) {
  if (to !== holder) [asker] = [UNASKED, turn(0, 0, 0)];
  holder = to;
  publish(`control/${OWNER}`, { ...holder, ...asker, named: NAMED, boot });
}

function receive(topic, payload, packet) {
  const [, account = "", metric] = /^(?:by\/([^/]*)\/)?(.+)$/.exec(topic.slice(IN.length));
  if (packet.retain) return; // a kept command is stale
  if (metric === "estop") return payload.length > 0 && halt(payload.toString(), account);
  try {
    let value = payload.length <= LONGEST ? JSON.parse(payload) : {};
    if (typeof value.value === "object") value = value.value;
    if (metric === "drive-values") drive(value, account);
    else if (account === "" && NAMED) return;
    else if (metric === "estop-reset") reset(value);
    else if (/^control(\/take)?$/.test(metric)) control(value, account, metric === "control/take");
  } catch {} // what cannot be read changes nothing
}

const options = {
  protocolVersion: 4, keepalive: 5, reconnectPeriod: 500, resubscribe: false, queueQoSZero: false, username: USER,
  password: NAMED ? fs.readFileSync(PASSWORD_FILE, "utf8").trim() : undefined, clientId: `robot-${ID}-${boot}`,
  will: { topic: OUT + "online", payload: JSON.stringify({ t: Date.now(), online: false }), qos: 1, retain: true },
};
const ca = NAMED ? fs.readFileSync(CA_FILE) : undefined;
const dial = () => (NAMED ? tls.connect({ port: PORT, host: HOST, ca }) : net.connect(PORT, HOST));
const client = new mqtt.MqttClient(dial, options);
client.on("error", () => {}); // it tries again
client.on("message", receive);
client.on("connect", () => {
  client.subscribe(IN + "#", { qos: 1 });
  publish("capabilities", { t: Date.now(), schema: "pebble-capabilities/v1", value: CAPABILITIES });
  publishStop(), passOn(holder), (shown = ""), turn(...wheels, until - now());
});
setInterval(() => {
  if (now() >= until) turn(0, 0, 0);
  if (holder.key !== "" && now() > lease.ends) passOn(NOBODY);
  if (asker !== UNASKED && now() > asksUntil) passOn(holder, (asker = UNASKED));
}, 20);
setInterval(() => client.connected && publish("online", { t: Date.now() }, 0), 250);

/**
 * Runs the page's own driving modules in virtual time, for several pages at once.
 *
 * node page.js FOLDER. Reads a line of JSON, ``{to, do: [[page, command, …], …]}``: does the commands, then runs timers
 * until that time, or until pages have sent something. Answers ``{now, due, out}``; ``due`` is the next timer.
 */

import { readSync, writeSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { Page, install, world } from "./browser.js";

const folder = pathToFileURL(`${process.argv[2]}/`);
const core = (name) => import(new URL(name, folder));
const { ControlSocket } = await core("control-socket.js");
const { Driver } = await core("driver.js");
const { Estop } = await core("estop.js");
const { Pads } = await core("pads.js");
const { Store } = await core("store.js");

const VERSION = "1";

/** As main.js ties them together. */
function load(page, ref) {
  const store = new Store(
    () => performance.now(),
    (flush) => flush(),
  );
  const socket = new ControlSocket({
    store,
    version: VERSION,
    can: [],
    onOpen: () => driver.opened(),
    onLost: () => driver.lost(),
    onRefused: (message) => driver.refused(message),
    onChange: () => driver.changed(),
  });
  const driver = new Driver({ socket, store, estop: new Estop(socket) });
  driver.pads = new Pads(driver);
  page.driver = driver;
  page.socket = socket;
  page.pointer = null;
  driver.start();
  socket.connect();
  driver.select(ref);
}

const commands = {
  load(number, options, ref) {
    const page = new Page(number, options);
    world.pages.set(number, page);
    page.run(() => load(page, ref));
  },
  gone: (page) => world.pages.delete(page.number),
  network(page, socket, what, value) {
    page.soon("network", () => {
      page.heard = world.now;
      page.sockets[socket].arrive(what, value);
    });
  },

  // -- what the human does
  key: (page, code, down) => page.key(code, down),
  held: (page, code) => page.held.set(code, world.now),
  meta: (page, down) => page.metaKey(down),
  shortcut: (page, code, more) => page.receives && page.keyEvent("keydown", code, false, more),
  stickStart(page, pointer, x, z) {
    const at = page.perf();
    page.soon("input", () => stickDown(page, pointer, x, z, at));
  },
  stickMove: (page, pointer, x, z) => page.soon("input", () => holds(page, pointer) && page.driver.stick(x, z)),
  stickEnd: (page, pointer) => page.soon("input", () => stickUp(page, pointer, () => page.driver.stickEnd())),
  stickCancel: (page, pointer) => page.soon("input", () => stickUp(page, pointer, () => page.driver.interrupt())),
  hold(page, name, value) {
    const at = page.perf();
    page.soon("input", () => holdButton(page, name, value, at));
  },
  sliders: (page, sliders) => page.soon("input", () => Object.assign(page.driver.sliders, sliders)),
  pad(page, pad) {
    page.pad = pad && { id: "pad", connected: true, ...pad };
    if (!pad) page.soon("input", () => page.dispatch("window", "gamepaddisconnected"));
  },
  take: (page, over) => page.soon("input", () => page.driver.take(over)),
  release: (page) => page.soon("input", () => page.driver.release()),
  select: (page, ref) => page.soon("input", () => page.driver.select(ref)),
  estop: (page) => page.soon("input", () => page.driver.latch("button")),
  reset: (page) => page.soon("input", () => resetStop(page)),

  // -- the window
  focus(page, focused) {
    if (page.focused === focused) return;
    page.focused = focused;
    page.soon("window", () => page.dispatch("window", focused ? "focus" : "blur"));
  },
  hidden(page, hidden) {
    if (page.hidden === hidden) return;
    page.hidden = hidden;
    if (!hidden) page.hurry();
    page.soon("window", () => page.dispatch("document", "visibilitychange"));
  },
  event: (page, where, name) => page.soon("window", () => page.dispatch(where, name)),
  dialog(page, open) {
    page.dialog = open;
  },

  // -- faults
  block: (page) => page.block(),
  unblock: (page, order) => page.unblock(order),
  asleep(page) {
    page.asleep = true;
  },
  awake(page, seconds) {
    page.asleep = false;
    page.paused += seconds;
  },
  wall(page, ms) {
    page.wall += ms;
  },

  ask(page) {
    const { driver, socket } = page;
    const reason = page.run(() => driver.reason());
    page.emit("state", {
      reason: reason?.code ?? "",
      action: reason?.action?.kind ?? "",
      ref: driver.ref,
      open: socket.state === "open",
      dragged: page.pointer !== null && holds(page, page.pointer),
      ended: !socket.again, // the server has ended the session
      token: page.storage.get("pebble-token") ?? "",
    });
  },
};

/** As ui/robot/stick.js does. */
function holds(page, pointer) {
  return page.pointer === pointer && page.driver.inputs.pointer === pointer;
}

function stickDown(page, pointer, x, z, at) {
  const { driver } = page;
  if (page.pointer !== null && holds(page, page.pointer)) driver.interrupt();
  else if (!driver.reason() && driver.stickStart(pointer, at)) {
    page.pointer = pointer;
    driver.stick(x, z);
  }
}

function stickUp(page, pointer, end) {
  if (!holds(page, pointer)) return;
  page.pointer = null;
  end();
}

/** As ui/robot/drive.js does. */
function holdButton(page, name, value, at) {
  if (!value || !page.driver.reason() || page.driver.gestureActive) page.driver.hold(name, value, at);
}

function resetStop(page) {
  const { driver } = page;
  const estop = driver.store.get(driver.ref, "web/estop")?.value;
  if (estop) driver.estop.reset(driver.ref, estop.owners);
}

function due() {
  let first = Infinity;
  for (const page of world.pages.values()) first = Math.min(first, page.due);
  return first;
}

/** Run the timers of idle pages that were not worth an answer. */
function catchUp(to) {
  for (;;) {
    let next = Infinity;
    for (const page of world.pages.values()) next = Math.min(next, page.next);
    if (next >= to) break;
    world.now = Math.max(world.now, next);
    for (const page of [...world.pages.values()]) page.tick();
    if (world.out.length) throw new Error("an idle page has done something");
  }
  world.now = Math.max(world.now, to);
}

function advance(to) {
  for (let next = due(); next <= to && !world.out.length; next = due()) {
    catchUp(next);
    for (const page of [...world.pages.values()]) page.tick();
  }
  if (!world.out.length) catchUp(to);
}

function answer(line) {
  const request = JSON.parse(line);
  if (request.begin) {
    world.pages.clear();
    [world.now, world.epoch] = request.begin;
  }
  world.out = [];
  catchUp(request.at);
  for (const [number, command, ...rest] of request.do) {
    const page = command === "load" ? number : world.pages.get(number);
    if (page === undefined) continue;
    commands[command](page, ...rest);
    if (command !== "network" && command !== "load" && command !== "ask") page.touched = world.now;
  }
  if (request.to !== undefined) advance(request.to);
  const next = due();
  return { now: world.now, due: next === Infinity ? null : next, out: world.out };
}

install();
const chunk = Buffer.alloc(1 << 16);
const write = (text) => {
  const bytes = Buffer.from(text);
  for (let at = 0; at < bytes.length; ) at += writeSync(1, bytes, at);
};
let pending = Buffer.alloc(0);
for (;;) {
  const size = readSync(0, chunk, 0, chunk.length, null);
  if (size === 0) break;
  pending = Buffer.concat([pending, chunk.subarray(0, size)]);
  for (let end = pending.indexOf(10); end >= 0; end = pending.indexOf(10)) {
    const line = pending.subarray(0, end).toString();
    pending = pending.subarray(end + 1);
    write(`${JSON.stringify(answer(line))}\n`);
  }
}

// Makes the parts of the page and joins them.

import { h, render } from "./vendor/preact.mjs";
import { ControlSocket } from "./core/control-socket.js";
import { Driver } from "./core/driver.js";
import { Estop } from "./core/estop.js";
import { Store } from "./core/store.js";
import { App, PARTS } from "./ui/app.js";
import { Boundary, Page, fetchPart, fetchRest, isHere, withRest } from "./ui/parts/hooks.js";
import { nameIn } from "./ui/parts/looks.js";
import { Connection, Panels, Route, Settings, WATCHES, read } from "./ui/parts/models.js";
import { Video } from "./ui/robot/video-model.js";
import { Pictures } from "./media/pictures.js";

const WATCHING = ["estop", "stop", "watch", "read-logs"]; // all that a screen sends that only watches
const REST_MS = 3000; // after the start everything is fetched, so that it is here without a server, too

const version = document.querySelector("meta[name=pebble-version]")?.getAttribute("content") ?? "";
const store = new Store();
const connection = new Connection(version);
const route = new Route();
const settings = new Settings();
const panels = new Panels();
const video = new Video(store);

function join() {
  const socket = new ControlSocket({
    store,
    version,
    maySend: (op) => !WATCHES || WATCHING.includes(op),
    onOpen: () => driver.opened(),
    onLost: () => driver.lost(),
    onChange: () => connection.changed(),
    name: () => String(settings.name).slice(0, 32),
    onLogs: (message) => connection.onLogs?.(message),
    onDone: (message) => connection.answered(message),
    onBye: (message) => {
      connection.bye = message.again ? null : message;
      connection.changed();
    },
    onRefused: (message) => {
      driver.refused(message);
      connection.answered(message);
      if (message.cmd !== "drive") connection.show(`Not done: ${message.why}`);
    },
  });
  const estop = new Estop(socket);
  const page = {
    nameOf: (ref) => nameIn(store, ref),
    isOld: () => connection.isOld,
    isLoading: () => !isHere(PARTS.robot),
    pictureAge: () => (!video.ref ? null : video.waits ? -1 : video.age().ms),
  };
  const driver = new Driver({ socket, store, estop, page });
  connection.socket = socket;
  estop.onChange = () => connection.changed();
  video.pictures = new Pictures(
    (bitmap, info) => {
      video.draw(bitmap, info);
      fetchRest();
    },
    (state) => video.report(state),
  );
  const services = { store, connection, route, settings, panels, video, driver, estop };
  return { ...services, commands: commands(socket, driver, estop), sound: undefined };
}

/** What widgets can ask for at once; ui/commands.js has the rest. */
function commands(socket, driver, estop) {
  return {
    stop: (ref) => {
      driver.stopped(() => estop.press(ref, ref ? "button" : "button, all"));
    },
    endStop: (stop) => estop.end(stop),
    reset: (ref, owners) => estop.reset(ref, owners),
    take: (over) => driver.take(over),
    stopScript: (ref) => socket.send({ op: "autonomy", ref, file: "" }),
  };
}

const page = join();
const follow = () => page.driver.select(route.ref);
route.onChange(follow);
page.driver.start();
follow();
render(h(Page.Provider, { value: page }, h(Boundary, { what: "This page", vital: true }, h(App))), document.getElementById("app"));
page.connection.socket.connect();
withRest(fetchMore);
if (!route.ref) fetchRest();
setTimeout(() => {
  fetchRest();
  Promise.allSettled(Object.values(PARTS).map((part) => fetchPart(part)));
}, REST_MS);

/** What keys, gamepads, cards and wall screens do besides; as often as it takes. @returns {Promise<void>} */
async function fetchMore(failures = 0) {
  let more;
  try {
    more = await import("./ui/more.js" + (failures ? `?${failures}` : ""));
  } catch {
    await new Promise((resolve) => setTimeout(resolve, REST_MS));
    return fetchMore(failures + 1);
  }
  more.install(page);
}

Object.assign(window, { pebble: page }); // for tests, and for people who look into it

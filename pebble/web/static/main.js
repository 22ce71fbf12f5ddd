// Makes the parts of the page and joins them.

import { h, render } from "./vendor/preact.mjs";
import { ControlSocket } from "./core/control-socket.js";
import { Driver } from "./core/driver.js";
import { Estop } from "./core/estop.js";
import { Store } from "./core/store.js";
import { App, PARTS } from "./ui/app.js";
import { Page, fetchPart, fetchRest, isHere, withRest } from "./ui/hooks.js";
import { Connection, Panels, Route, Settings, WATCHES, read } from "./ui/models.js";
import { Video } from "./ui/video-model.js";
import { Pictures } from "./media/pictures.js";

const WATCHING = ["estop", "stop", "watch", "read-logs"]; // all that a screen sends that only watches
const IDLE_MS = 55_000; // the server ends what is not used for a minute
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
    onSeries: (message) =>
      store.metrics(message.ref).length && store.set(message.ref, `web/series/${message.metric}`, message),
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
  const driver = new Driver({ socket, store, estop, reload: () => connection.isOld });
  connection.socket = socket;
  estop.onChange = () => connection.changed();
  driver.onControlLost = (by, idleMs) => connection.show(controlEnd(by, idleMs));
  if (read("pads", null)) driver.mappingOf = () => null; // until ui/more.js is here they only stop
  driver.loading = () => !isHere(PARTS.robot);
  driver.pictureAge = () => (video.ref ? video.age().ms : null);
  video.pictures = new Pictures(
    (bitmap, info) => {
      video.draw(bitmap, info);
      fetchRest();
    },
    (state) => video.report(state),
  );
  const services = { store, connection, route, settings, panels, video, driver, estop };
  return { ...services, commands: commands(socket, driver, estop), sound: sound(services) };
}

/** Listening and talking, fetched with its controls, or when a key asks for it. */
/** @param {string} by who has it now @param {number} idleMs since this page drove */
function controlEnd(by, idleMs) {
  const why = idleMs > IDLE_MS ? "after a minute without driving" : "with the connection";
  return by ? `${by} took over` : `Your control has ended ${why}: take it again`;
}

function sound(services) {
  let held = false;
  const use = async (act) => {
    const { Sound } = await import("./ui/sound-model.js");
    act((one.model ??= new Sound(services)));
  };
  const one = {
    model: null,
    talk(on) {
      held = on;
      use((model) => model.talk(held)).catch((error) => services.connection.show(`Not done: ${error.message}`));
    },
    toggleMute: () => one.model?.toggleMute(),
  };
  services.driver.onInterrupt = () => one.model?.interrupt();
  return one;
}

/** Everything that widgets can ask for. */
function commands(socket, driver, estop) {
  let asked = 0;
  /** Of a robot: the number that the answer carries, see Connection.answers; 0: it was not sent. */
  const ask = (op) => (socket.send({ ...op, n: ++asked }) ? asked : 0);
  return {
    stop: (ref) => {
      driver.interrupt();
      estop.press(ref, ref ? "button" : "button, all");
    },
    endStop: (stop) => estop.end(stop),
    reset: (ref, owners) => estop.reset(ref, owners),
    take: (over) => driver.take(over),
    release: () => driver.release(),
    askSeries: (ref) => socket.send({ op: "watch", ref, series: true }),
    setEncoding: (ref, encoding) => socket.send({ op: "encoding", ref, encoding }),
    setPictureFrom: (ref, source) => socket.send({ op: "picture-from", ref, source }),
    setStreamAddress: (ref, url) => socket.send({ op: "stream-address", ref, url }),
    /** @param {string} ref @param {{r: number, g: number, b: number, period?: number}} colour each 0..1; seconds */
    setLights: (ref, colour) => ask({ op: "lights", ref, ...colour }),
    playSound: (ref, file, repeat = false) => ask({ op: "soundboard", ref, file, repeat }),
    stopSound: (ref) => ask({ op: "soundboard", ref, file: "" }),
    startScript: (ref, file, config) => ask({ op: "autonomy", ref, file, config }),
    stopScript: (ref) => ask({ op: "autonomy", ref, file: "" }),
    switchOutlet: (ref, outlet, on) => ask({ op: "outlet", ref, outlet, on }),
    commandMcu: (ref, uid, name, value) => ask({ op: "mcu", ref, uid, name, value }),
    /** @param {string} ref @param {"reboot" | "service-restart" | "git-pull"} name */
    act: (ref, name) => ask({ op: "action", ref, name }),
    /** @param {string} ref @param {"remote-mirror" | "mqtt-audio" | "mqtt-video"} name @param {boolean} on */
    setFlag: (ref, name, on) => ask({ op: "flag", ref, name, on }),
    readLogs: (ref, on, origin = "", after = 0) => socket.send({ op: "read-logs", ref, on, origin, after }),
    /** What others see of who this is, where there is no login; it connects anew. */
    setName(name) {
      settings.set("name", name);
      socket.restart();
    },
    async logOut() {
      const headers = { "content-type": "application/json" };
      await fetch("/api/logout", { method: "POST", headers, body: "{}" }).catch(() => {});
      location.assign("/login");
    },
  };
}

const page = join();
const follow = () => page.driver.select(route.ref);
route.onChange(follow);
page.driver.start();
follow();
render(h(Page.Provider, { value: page }, h(App)), document.getElementById("app"));
page.connection.socket.connect();
withRest(fetchMore);
if (!route.ref) fetchRest();
setTimeout(() => {
  fetchRest();
  Promise.allSettled(Object.values(PARTS).map(fetchPart));
}, REST_MS);

/** What keys, gamepad and wall screens do besides; as often as it takes. */
function fetchMore() {
  import("./ui/more.js").then(({ install }) => install(page), () => setTimeout(fetchMore, REST_MS));
}

Object.assign(window, { pebble: page }); // for tests, and for people who look into it

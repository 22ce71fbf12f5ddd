// What the cards and panels can ask for, besides driving and stops.

import { ROOT } from "../core/browser.js";

/** @param {any} page */
export function install(page) {
  const { commands, settings, connection: { socket } } = page;
  page.sound = sound(page);
  let asked = 0;
  /** Of a robot: the number that the answer carries, see Connection.answers; 0: it was not sent. */
  const ask = (op) => (socket.send({ ...op, n: ++asked }) ? asked : 0);
  Object.assign(commands, {
    setPictureFrom: (ref, source) => socket.send({ op: "picture-from", ref, source }),
    /** @param {string} ref @param {{r: number, g: number, b: number, period?: number}} colour each 0..1; seconds */
    setLights: (ref, colour) => ask({ op: "lights", ref, ...colour }),
    playSound: (ref, file, repeat = false) => ask({ op: "soundboard", ref, file, repeat }),
    stopSound: (ref) => ask({ op: "soundboard", ref, file: "" }),
    startScript: (ref, file, config) => ask({ op: "autonomy", ref, file, config }),
    switchOutlet: (ref, outlet, on) => ask({ op: "outlet", ref, outlet, on }),
    commandMcu: (ref, uid, name, value) => ask({ op: "mcu", ref, uid, name, value }),
    /** @param {string} ref @param {"reboot" | "service-restart" | "git-pull"} name */
    act: (ref, name) => ask({ op: "action", ref, name }),
    /** @param {string} ref @param {"allow" | "withdraw" | "clear"} what @param {boolean} extra */
    askBoard: (ref, what, extra) => ask({ op: "board", ref, do: what, extra }),
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
      await fetch(`${ROOT}api/logout`, { method: "POST", headers, body: "{}" }).catch(() => {});
      location.assign(`${ROOT}login`);
    },
  });
}

/** Listening and talking, fetched with its controls, or when a key asks for it. */
function sound(services) {
  let held = false;
  const use = async (act) => {
    const { Sound } = await import("./robot/sound-model.js");
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

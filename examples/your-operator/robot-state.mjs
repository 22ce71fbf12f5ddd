// What an operator knows of a robot, by the messages that it publishes.

export const METRICS = ["online", "capabilities", "link", "estop/+", "control/+"];
const SILENT_MS = { wide: 1500, narrow: 3000, thin: 5000 }; // without a heartbeat, by the level of the link
const WIDE = { level: "wide", drive_hz: 20 }; // a link that carries everything: robots that report none have it

/** One robot. */
export class RobotState {
  capabilities = {};
  link = WIDE; // what the way to the robot carries
  stops = new Map(); // the state of the emergency stop, by the name of each owner of motors
  controls = new Map(); // who has control, by the same
  isOffline = true;
  heartbeatAt = -Infinity;
  shownHolder = "";

  disconnect() {
    this.isOffline = true;
    this.controls.clear();
  }

  /** Take one message below outgoing/; one that cannot be read changes nothing. */
  receive(metric, payload, retained) {
    try {
      this.take(metric, payload.length > 0 ? JSON.parse(payload) : {}, retained);
    } catch (error) {
      console.log(`cannot be read: ${metric}: ${error.message}`);
    }
  }

  take(metric, value, retained) {
    const [name, owner] = metric.split("/");
    if (name === "online" && !retained) {
      // a retained heartbeat is no sign of life
      this.heartbeatAt = performance.now();
      this.isOffline = value.online === false;
    } else if (name === "capabilities") {
      this.capabilities = { ...value.value };
    } else if (name === "link") {
      this.link = Number.isFinite(value.drive_hz) ? value : WIDE;
    } else if (name === "estop") {
      this.stops.set(owner, { ...value });
    } else if (name === "control") {
      this.controls.set(owner, { ...value });
      if (value.asks) {
        console.log(`${value.asks} asks for control`);
      }
    }
  }

  isWide() {
    return this.link.level === "wide";
  }

  isSilent() {
    const limit = SILENT_MS[this.link.level] ?? SILENT_MS.wide;
    return this.isOffline || performance.now() > this.heartbeatAt + limit;
  }

  /** Without those of owners that capabilities do not list: a broker keeps them after a renaming. */
  known(states) {
    const owners = this.capabilities.estop?.owners;
    return new Map([...states].filter(([owner]) => !owners?.length || owners.includes(owner)));
  }

  isStopped() {
    return [...this.known(this.stops).values()].some((stop) => stop.latched !== false);
  }

  /** True if each owner of motors tells that it has the emergency stop of this name. */
  hasStop(name) {
    const owners = this.capabilities.estop?.owners ?? [...this.stops.keys()];
    return owners.length > 0 && owners.every((owner) => this.stops.get(owner)?.recent?.includes(name));
  }

  /** True if no command with another key than that of who has control moves it. */
  givesControl() {
    return this.capabilities.drive?.control === true;
  }

  /** The keys of all owners that gave control to this id; "" if the first by name did not, who decides. */
  key(id) {
    const owners = [...this.known(this.controls).keys()].sort();
    const keys = owners.map((owner) => {
      const control = this.controls.get(owner);
      return (control.id === id && control.key) || "";
    });
    return keys[0] ? keys.filter(Boolean).join(" ") : "";
  }

  /** Print once that another client has control. */
  showHolder(id) {
    const controls = [...this.known(this.controls).values()];
    const other = controls.find((control) => control.key && control.id !== id);
    const holder = other ? other.by || "another" : "";
    if (holder && holder !== this.shownHolder) {
      console.log(`${holder} has control, asking`);
    }
    this.shownHolder = holder;
  }
}

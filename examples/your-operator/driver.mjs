// Drives a robot by a stick: asks for control, sends commands while the stick is pushed, and gives control back.
import { randomBytes } from "node:crypto";

const ASKS_MS = 1000; // control ends unless it is asked for again and again
const KEEPS_MS = 3000; // so long after the last command it is given back

/** One person at one robot. send(metric, value, qos) publishes below incoming/. */
export class Driver {
  id = randomBytes(4).toString("hex");
  stick = { x: 0, z: 0 }; // x steers, z drives
  isMoving = false;
  mustLetGo = false; // a stick that is held down must not drive on later
  movedAt = -Infinity;
  askedAt = -Infinity;
  sentAt = -Infinity;

  /** robot: what is known of it, see robot-state.mjs. */
  constructor(robot, name, send) {
    this.robot = robot;
    this.name = name;
    this.send = send;
  }

  isPushed() {
    return this.stick.x !== 0 || this.stick.z !== 0;
  }

  /** Put the stick there; what is no number lets it go. */
  push(x, z) {
    const areNumbers = Number.isFinite(x) && Number.isFinite(z);
    this.stick = areNumbers ? { x: clamp(x, -1, 1), z: clamp(z, -1, 1) } : { x: 0, z: 0 };
    if (!this.isPushed()) {
      this.mustLetGo = false;
      this.isMoving = false;
      const key = this.robot.key(this.id);
      this.send("drive-values", key ? { x: 0, z: 0, key } : { x: 0, z: 0 }, 1);
    }
  }

  /** Call it often. isStopping: an emergency stop was pressed, and is not confirmed yet. */
  step(isStopping) {
    const now = performance.now();
    const whyNot = this.whyNot(isStopping);
    if (this.isPushed() && !this.mustLetGo && whyNot) {
      console.log(whyNot);
      this.mustLetGo = true;
      this.isMoving = false;
    }
    const wantsToMove = this.isPushed() && !this.mustLetGo;
    if (wantsToMove) {
      this.movedAt = now;
    }
    if (this.robot.givesControl()) {
      this.keepControl(now);
    }
    const mayMove = this.robot.key(this.id) || !this.robot.givesControl();
    if (wantsToMove && mayMove) {
      this.sendStick(now);
    }
  }

  /** Why nothing may move; empty if it may. */
  whyNot(isStopping) {
    if (this.robot.isSilent()) {
      return "the robot is silent";
    }
    if (this.robot.isStopped() || isStopping) {
      return "the robot is stopped";
    }
    if (this.isMoving && this.robot.givesControl() && !this.robot.key(this.id)) {
      return "another has control now";
    }
    return "";
  }

  keepControl(now) {
    if (now >= this.movedAt + KEEPS_MS) {
      if (this.robot.key(this.id)) {
        this.release();
      }
    } else if (now >= this.askedAt + ASKS_MS) {
      this.askedAt = now;
      this.request("hold");
      this.robot.showHolder(this.id);
    }
  }

  release() {
    this.request("release");
    this.robot.controls.clear();
  }

  request(want) {
    const request = { id: this.id, want, for_ms: 3000, by: this.name, device: "sample" };
    this.send("control", this.robot.isWide() ? request : { ...request, for_ms: 10_000, t: clockMs() }, 1);
  }

  /** Send as many commands as the link carries: more would queue, and a stop would wait behind them. */
  sendStick(now) {
    const hz = clamp(this.robot.link.drive_hz, 2, 20);
    if (now < this.sentAt + 1000 / hz) {
      return;
    }
    this.sentAt = now;
    this.isMoving = true;
    const isWide = this.robot.isWide();
    const command = { ...this.stick, valid_ms: isWide ? 400 : 750 };
    const key = this.robot.key(this.id);
    this.send("drive-values", key ? { ...command, key, t: clockMs() } : command, isWide ? 1 : 0);
  }
}

/** Milliseconds of a clock that is never set: by them a robot drops commands that come late. */
function clockMs() {
  return Math.floor(performance.now());
}

function clamp(value, least, most) {
  return Math.max(least, Math.min(most, value));
}

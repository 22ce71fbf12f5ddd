// Generated from pebble/extensions/page/messages.py by python tools/messages_docs.py.

export interface Hello {
  op: "hello";
  version: string;
  device?: string;
  name?: string;
  token?: string;
}

export interface Echo {
  op: "echo";
  n: number;
  t: number;
}

export interface Watch {
  op: "watch";
  ref: string;
}

export interface ReadLogs {
  op: "read-logs";
  ref: string;
  on: boolean;
  origin?: string;
  after?: number;
}

export interface Lease {
  op: "lease";
  ref: string;
  take: boolean;
  over?: boolean;
}

export interface DriveOp {
  op: "drive";
  ref: string;
  g: number;
  t: number;
  x?: number;
  z?: number;
  y?: number;
  final?: boolean;
}

export interface StopOp {
  op: "stop";
  ref: string;
}

export interface EstopOp {
  op: "estop";
  ref: string;
  stop: string;
  why?: string;
}

export interface EstopEndOp {
  op: "estop-end";
  stop: string;
}

export interface EstopResetOp {
  op: "estop-reset";
  ref: string;
  owners: ShownOwner[];
}

export interface PictureFromOp {
  op: "picture-from";
  ref: string;
  source: string;
}

export interface BoardOp {
  op: "board";
  n?: number;
  ref: string;
  do: "allow" | "clear" | "withdraw";
  extra?: boolean;
}

export interface LightsOp {
  op: "lights";
  n?: number;
  ref: string;
  r?: number;
  g?: number;
  b?: number;
  period?: number | null;
}

export interface SoundboardOp {
  op: "soundboard";
  n?: number;
  ref: string;
  file: string;
  repeat?: boolean;
}

export interface AutonomyOp {
  op: "autonomy";
  n?: number;
  ref: string;
  file: string;
  config?: Record<string, string | number | number | boolean | null>;
}

export interface OutletOp {
  op: "outlet";
  n?: number;
  ref: string;
  outlet: string;
  on: boolean;
}

export interface McuOp {
  op: "mcu";
  n?: number;
  ref: string;
  uid: string;
  name: string;
  value: Record<string, boolean | number | number>;
}

export interface ActionOp {
  op: "action";
  n?: number;
  ref: string;
  name: "git-pull" | "reboot" | "service-restart";
}

export interface FlagOp {
  op: "flag";
  n?: number;
  ref: string;
  name: "mqtt-audio" | "mqtt-video" | "remote-mirror";
  on: boolean;
}

export interface Welcome {
  op: "welcome";
  server: string;
  version: string;
  user: string;
  role: string;
  rights: string[];
  named_rights: string[];
  login: boolean;
  token: string;
  now: number;
  recordings?: boolean;
  drives?: boolean;
  words?: Record<string, string>;
}

export interface Ping {
  op: "ping";
  n: number;
  now: number;
  round_trip_ms?: number;
}

export interface State {
  op: "state";
  now: number;
  set: [string, string, any, number][];
  gone?: string[];
}

export interface Logs {
  op: "logs";
  ref: string;
  origin: string;
  first: number;
  lines: any[];
}

export interface Refused {
  op: "refused";
  cmd: string;
  ref: string;
  why: string;
  g?: number;
  n?: number;
}

export interface Done {
  op: "done";
  cmd: string;
  ref: string;
  n?: number;
}

export interface Bye {
  op: "bye";
  why: string;
  again: boolean;
}

export interface Seek {
  op: "seek";
  at: number;
}

export interface Play {
  op: "play";
  on: boolean;
}

export interface Speed {
  op: "speed";
  speed: number;
}

export interface Played {
  op: "played";
  at: number;
  on: boolean;
  speed: number;
  begins?: boolean;
  ended?: boolean;
  skipped?: [number, number] | null;
}

export interface ShownOwner {
  owner: string;
  boot: string;
  count: number;
}

export interface TalkAnswer {
  talk: number;
  on: boolean;
  why?: string;
}

export interface RobotIdentity {
  system: string;
  type: string;
  id: string;
  name?: string;
  description?: string;
  colour?: "amber" | "blue" | "coral" | "green" | "rose" | "slate" | "teal" | "violet";
  picture?: "arm" | "benjr" | "boat" | "drone" | "fred" | "goob" | "minilamp" | "outlets" | "pitcam" | "unknown" | "walker" | "wheeled";
  battery_cells?: number;
}

export interface OwnerState {
  owner: string;
  latched: boolean;
  boot: string;
  count: number;
  by: string;
  why: string;
  since: number;
  persisted: boolean | null;
  reset_refused: string | null;
}

export interface Liveness {
  online: boolean | null;
  silent_s: number | null;
  latency_ms: number | null;
  average_latency_ms: number | null;
  interval_ms: number | null;
  whole_seconds: boolean;
}

export interface EstopView {
  available: boolean;
  latched: boolean;
  by: string;
  why: string;
  since: number;
  owners: OwnerState[];
  sending: string;
  sending_text: string;
  stop: string;
}

export interface DriverView {
  by?: string;
  device?: string;
  you?: boolean;
  idle_s?: number | null;
  keeps?: boolean;
  asking?: boolean;
  asks?: string;
  checked?: boolean;
  others?: boolean;
}

export interface PictureView {
  state: string;
  why: string;
  encoding: string;
  per_second: number;
  kbits: number;
  viewers: number;
}

export interface SoundView {
  state: string;
  why: string;
  encoding: string;
  listeners: number;
  talker: string;
}

export interface PictureFrom {
  source: string;
}

export interface FlagsView {
  remote_mirror?: boolean | null;
  mqtt_audio?: boolean | null;
  mqtt_video?: boolean | null;
}

export interface BoardView {
  silent: boolean;
  by?: string;
  refused?: string;
  parked?: string;
  risk?: string;
}

export interface BrokerView {
  connected: boolean;
  problem: string;
  not_received: string;
  robots_omitted: number;
  stops_omitted: boolean;
}

export interface Metrics {
  "web/liveness": Liveness;
  "web/estop": EstopView;
  "web/driver": DriverView;
  "web/picture": PictureView;
  "web/sound": SoundView;
  "web/picture-from": PictureFrom;
  "web/flags": FlagsView;
  "web/board": BoardView;
  "web/broker": BrokerView;
}

export type FromPage = Hello | Echo | Watch | ReadLogs | Lease | DriveOp | StopOp | EstopOp | EstopEndOp | EstopResetOp | PictureFromOp | BoardOp | LightsOp | SoundboardOp | AutonomyOp | OutletOp | McuOp | ActionOp | FlagOp;

export type ToPage = Welcome | Ping | State | Logs | Refused | Done | Bye;

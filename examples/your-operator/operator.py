"""The smallest honest operator, with paho alone:  operator.py ID HOST PORT [USER PASSWORD_FILE CA_FILE]
Each line of standard input is a command: "0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" lets go,
"stop" and "reset" are the emergency stop; at its end control is released. With a user its commands bear this name."""

import json, math, secrets, select, sys, time
from contextlib import suppress
import paho.mqtt.client as mqtt

ID, HOST, PORT, *LOGIN = sys.argv[1:]
PLAIN, OUT = f"pebble/robots/{ID}/incoming/", f"pebble/robots/{ID}/outgoing/"
IN = f"{PLAIN}by/{LOGIN[0]}/" if LOGIN else PLAIN
SILENT_S, WIDE = {"wide": 1.5, "narrow": 3.0, "thin": 5.0}, {"level": "wide", "drive_hz": 20.0}
LETS_GO_S, REPEATS_S, GIVES_UP_S = 3.0, 0.5, 60.0
now, ms = time.monotonic, lambda: int(1000 * time.monotonic())  # of a clock that is never set


class Operator:
    def __init__(self):
        self.id, self.stick, self.moves, self.blocked = secrets.token_hex(4), (0.0, 0.0), False, False
        self.seen, self.offline, self.capabilities, self.link = -math.inf, True, {}, WIDE
        self.stops, self.control = {}, {}  # the states of all motor owners, by the name of the owner
        self.drives_at = self.asks_at = self.moved_at = -math.inf
        self.pressed = None  # an emergency stop that is not confirmed: its name, and from when to when it is repeated

    def send(self, metric, value, qos=1):
        client.publish(IN + metric, json.dumps(value), qos)

    @property
    def controlled(self):
        return (self.capabilities.get("drive") or {}).get("control") is True

    @property
    def key(self):
        """It has the keys of all owners; the first owner by name decides who drives."""
        own = [(state.get("id") == self.id and state.get("key")) or "" for _, state in sorted(self.control.items())]
        return " ".join(filter(None, own)) if own and own[0] else ""

    @property
    def why_not(self):
        """Why nothing may move; empty if it may."""
        if self.offline or now() > self.seen + SILENT_S.get(self.link["level"], 1.5):
            return "the robot is silent"
        if any(state.get("latched") is not False for state in self.stops.values()) or self.pressed:
            return "the robot is stopped"
        return "let go first" if self.blocked else ""

    def push(self, x, z):
        """The stick is here now; what is no number lets it go."""
        numbers = math.isfinite(x) and math.isfinite(z)
        self.stick = (max(-1.0, min(1.0, x)), max(-1.0, min(1.0, z))) if numbers else (0.0, 0.0)
        if self.stick == (0.0, 0.0):
            self.blocked = self.moves = False
            self.send("drive-values", {"x": 0, "z": 0} | ({"key": self.key} if self.key else {}))

    def drive(self):
        """Often enough for the wheels to turn on, and no more often than the link carries."""
        pushed = self.stick != (0.0, 0.0)
        if pushed and (self.why_not or (self.moves and self.controlled and not self.key)):
            self.blocked, self.moves = True, False  # who holds the stick down must not drive on later
        if pushed and not self.why_not:
            self.moved_at = now()
        if self.controlled and now() >= self.asks_at and now() < self.moved_at + LETS_GO_S:
            self.asks_at = now() + 1.0
            self.request("hold")
        elif self.key and now() > self.moved_at + LETS_GO_S:
            self.request("release")
            self.control = {}
        if not pushed or self.why_not or (self.controlled and not self.key) or now() < self.drives_at:
            return
        wide = self.link["level"] == "wide"
        self.drives_at = max(self.drives_at, now() - 0.1) + 1 / max(2.0, min(20.0, self.link["drive_hz"]))
        command = {"x": self.stick[0], "z": self.stick[1], "valid_ms": 400 if wide else 750}
        self.send("drive-values", command | ({"key": self.key, "t": ms()} if self.key else {}), int(wide))
        self.moves = True

    def request(self, want):
        value = {"id": self.id, "want": want, "for_ms": 3000, "by": LOGIN[0] if LOGIN else "sample", "device": "sample"}
        self.send("control", value if self.link["level"] == "wide" else value | {"for_ms": 10_000, "t": ms()})

    def press(self):
        self.pressed = {"stop": secrets.token_hex(8), "by": LOGIN[0] if LOGIN else "sample"}, now(), now() + GIVES_UP_S

    def repeat_stop(self):
        """An emergency stop is repeated until every owner has its name, or a minute has gone by."""
        stop, at, end = self.pressed
        owners = (self.capabilities.get("estop") or {}).get("owners") or self.stops
        confirmed = owners and all(stop["stop"] in self.stops.get(one, {}).get("recent", ()) for one in owners)
        if confirmed or now() > end:
            self.pressed = None
        elif now() >= at:
            self.pressed = stop, now() + REPEATS_S, end
            for topic in {PLAIN, IN}:  # a stop needs no name
                client.publish(topic + "estop", json.dumps(stop), 1)

    def reset(self):
        """End the stops that are shown now, and no later one."""
        for state in self.stops.values():
            self.send("estop-reset", {"boot": state.get("boot"), "count": state.get("count")})

    def receive(self, _client, _data, message):
        metric = message.topic.removeprefix(OUT)
        with suppress(ValueError, TypeError, AttributeError, KeyError, RecursionError):
            value = json.loads(message.payload) if message.payload else {}
            if metric == "online" and not message.retain:
                self.seen, self.offline = now(), value.get("online") is False
            elif metric == "capabilities":
                self.capabilities = dict(value["value"])
            elif metric == "link":
                self.link = {"level": str(value["level"]), "drive_hz": float(value["drive_hz"])} if value else WIDE
            elif metric.startswith("estop/"):
                self.stops[metric.removeprefix("estop/")] = dict(value)
            elif metric.startswith("control/"):
                self.control[metric.removeprefix("control/")] = dict(value)
                if value.get("asks"):
                    print(value["asks"], "asks for control", flush=True)

    def line(self, text):
        if text in ("stop", "reset"):
            return self.press() if text == "stop" else self.reset()
        with suppress(ValueError):
            self.push(*(float(one) for one in f"{text} 0 0".split()[:2]))

    def connected(self, *_):
        client.subscribe([(OUT + one, 1) for one in ("online", "capabilities", "link", "estop/+", "control/+")])


operator, client, lines = Operator(), mqtt.Client(mqtt.CallbackAPIVersion.VERSION2), b""
if LOGIN:
    client.username_pw_set(LOGIN[0], open(LOGIN[1]).read().strip()), client.tls_set(LOGIN[2])
client.on_connect, client.on_message = operator.connected, operator.receive
client.connect_async(HOST, int(PORT), keepalive=5)
while True:
    if client.loop(0.01) != mqtt.MQTT_ERR_SUCCESS:
        operator.offline, operator.control = True, {}
        time.sleep(0.2)
        with suppress(OSError):
            client.reconnect()
    if select.select([sys.stdin], [], [], 0)[0]:
        if not (read := sys.stdin.buffer.read1()):
            break
        *whole, lines = (lines + read).split(b"\n")
        for one in whole:
            operator.line(one.decode(errors="replace").strip())
    operator.drive()
    if operator.pressed:
        operator.repeat_stop()
operator.push(0.0, 0.0)
operator.request("release")
client.loop_start()
time.sleep(0.3)

"""The smallest honest operator in MicroPython, on an ESP32 or a Pico W, with mqtt.py of the robot. Your settings.py has
WIFI, WIFI_PASSWORD, ID, HOST, PORT, and LOGIN: () or user, password and the broker's CA in PEM. Lines of the console
are commands: "0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" lets go, "stop" and "reset" are the
emergency stop; at its end control is released. With a user its commands bear this name."""

import binascii, json, network, os, select, sys, time
from mqtt import Mqtt
from settings import HOST, ID, LOGIN, PORT, WIFI, WIFI_PASSWORD

ALL, OUT, BY = f"pebble/robots/{ID}/incoming/", f"pebble/robots/{ID}/outgoing/", LOGIN[0] if LOGIN else "sample"
IN = f"{ALL}by/{BY}/" if LOGIN else ALL
SILENT_MS, WIDE = {"wide": 1500, "narrow": 3000, "thin": 5000}, {"level": "wide", "drive_hz": 20}
LETS_GO_MS, REPEATS_MS, GIVES_UP_MS = 3000, 500, 60000
now, later = time.ticks_ms, lambda ms: time.ticks_add(time.ticks_ms(), int(ms))
left_ms, token = lambda at: time.ticks_diff(at, now()), lambda size: binascii.hexlify(os.urandom(size)).decode()
clamp = lambda value, least, most: max(least, min(most, value))  # noqa: E731


class Operator:
    def __init__(self):
        self.id, self.stick, self.moves, self.blocked = token(4), (0, 0), False, False
        self.silent_at, self.offline, self.capabilities, self.link = now(), True, {}, WIDE
        self.stops, self.control = {}, {}  # the states of all motor owners, by the name of the owner
        self.drives_at = self.asks_at = self.idle_at = now()
        self.pressed = None  # an emergency stop that is not confirmed: its name, and from when to when it is repeated
        self.clock, self.clock_at = 0, now()  # milliseconds since its start: the counter of ticks wraps

    def stamp(self):
        self.clock, self.clock_at = self.clock + time.ticks_diff(now(), self.clock_at), now()
        return self.clock

    def controlled(self):
        return (self.capabilities.get("drive") or {}).get("control") is True

    def key(self):  # the keys of all owners; the first owner by name decides who drives
        states = [self.control[owner] for owner in sorted(self.control)]
        own = [state.get("key") or "" if state.get("id") == self.id else "" for state in states]
        return " ".join([one for one in own if one]) if own and own[0] else ""

    def why_not(self):  # why nothing may move; empty if it may
        if self.offline or left_ms(self.silent_at) < 0:
            return "the robot is silent"
        if self.pressed or [one for one in self.stops.values() if one.get("latched") is not False]:
            return "the robot is stopped"
        return "let go first" if self.blocked else ""

    def push(self, x, z):  # the stick is here now; what is no number lets it go
        numbers = x - x == 0 and z - z == 0
        self.stick = (clamp(x, -1, 1), clamp(z, -1, 1)) if numbers else (0, 0)
        if not any(self.stick):
            self.blocked = self.moves = False
            client.publish(IN + "drive-values", dict(x=0, z=0, **({"key": self.key()} if self.key() else {})))

    def drive(self):  # often enough for the wheels to turn on, and no more often than the link carries
        pushed, why_not, key = any(self.stick), self.why_not(), self.key()
        if pushed and (why_not or (self.moves and self.controlled() and not key)):
            self.blocked, self.moves, why_not = True, False, "let go first"  # a held stick must not drive on later
        if pushed and not why_not:
            self.idle_at = later(LETS_GO_MS)
        if self.controlled() and left_ms(self.asks_at) <= 0 and left_ms(self.idle_at) > 0:
            self.asks_at = later(1000)
            self.request("hold")
        elif key and left_ms(self.idle_at) <= 0:
            self.request("release")
            self.control = {}
        if not pushed or why_not or (self.controlled() and not key) or left_ms(self.drives_at) > 0:
            return
        wide, late_ms = self.link["level"] == "wide", min(100, -left_ms(self.drives_at))
        self.moves, self.drives_at = True, later(1000 / clamp(self.link["drive_hz"], 2, 20) - late_ms)
        command = {"x": self.stick[0], "z": self.stick[1], "valid_ms": 400 if wide else 750}
        command.update({"key": key, "t": self.stamp()} if key else {})
        client.publish(IN + "drive-values", command, int(wide))

    def request(self, want):
        value = {"id": self.id, "want": want, "for_ms": 3000, "by": BY, "device": "sample"}
        value.update({} if self.link["level"] == "wide" else {"for_ms": 10000, "t": self.stamp()})
        client.publish(IN + "control", value)

    def repeat_stop(self):  # until every owner has its name, or a minute has gone by
        stop, at, end = self.pressed
        owners = (self.capabilities.get("estop") or {}).get("owners") or list(self.stops)
        have = [one for one in owners if stop["stop"] in self.stops.get(one, {}).get("recent", ())]
        if (owners and len(have) == len(owners)) or left_ms(end) < 0:
            self.pressed = None
        elif left_ms(at) <= 0:
            self.pressed = stop, later(REPEATS_MS), end
            for topic in {ALL, IN}:  # a stop needs no name
                client.publish(topic + "estop", stop)

    def receive(self, topic, payload, retained):
        metric, _, owner = topic[len(OUT) :].partition("/")
        try:
            value = json.loads(payload) if payload else {}
            if metric == "online" and not retained:
                self.silent_at, self.offline = (
                    later(SILENT_MS.get(self.link["level"], 1500)),
                    value.get("online") is False,
                )
            elif metric == "capabilities":
                self.capabilities = dict(value["value"])
            elif metric == "link":
                self.link = {"level": str(value["level"]), "drive_hz": float(value["drive_hz"])} if value else WIDE
            elif owner and metric in ("estop", "control"):
                (self.stops if metric == "estop" else self.control)[owner] = dict(value)
                if value.get("asks"):
                    print(value["asks"], "asks for control")
        except (ValueError, TypeError, AttributeError, KeyError, RuntimeError, MemoryError):
            pass

    def line(self, text):
        if text == "stop":
            self.pressed = {"stop": token(8), "by": BY}, now(), later(GIVES_UP_MS)
        elif text == "reset":  # ends the stops that are shown now, and no later one
            for state in self.stops.values():
                client.publish(IN + "estop-reset", {"boot": state.get("boot"), "count": state.get("count")})
        else:
            try:  # noqa: SIM105 - boards have no contextlib
                self.push(*[float(one) for one in (text + " 0 0").split()[:2]])
            except ValueError:
                pass

    def connected(self):
        client.subscribe(*[OUT + one for one in ("online", "capabilities", "link", "estop/+", "control/+")])

    def lost(self):
        self.offline, self.control = True, {}


operator, person, wifi = Operator(), select.poll(), network.WLAN(network.STA_IF)
client = Mqtt(HOST, PORT, "operator-" + operator.id, LOGIN, operator.connected, operator.lost)
wifi.active(True), wifi.connect(WIFI, WIFI_PASSWORD), person.register(sys.stdin, select.POLLIN)
typed = "\n"
while typed:
    for message in client.messages(10):
        operator.receive(*message)
    if person.poll(0):
        typed = sys.stdin.readline()  # empty: its end
        operator.line(typed.strip())
    operator.drive()
    if operator.pressed:
        operator.repeat_stop()
operator.push(0, 0)
operator.request("release")
for _ in range(10):
    list(client.messages(20))

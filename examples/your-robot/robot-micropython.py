"""The smallest honest robot in MicroPython (ESP32, Pico W), with mqtt.py. Your settings.py has WIFI, WIFI_PASSWORD, ID,
HOST, PORT, STOP_FILE and LOGIN: (), or for level named user, password and the broker's CA in PEM."""

import binascii, json, network, os, time
from mqtt import Mqtt
from settings import HOST, ID, LOGIN, PORT, STOP_FILE, WIFI, WIFI_PASSWORD

NAMED, IN, OUT = bool(LOGIN), f"pebble/robots/{ID}/incoming/", f"pebble/robots/{ID}/outgoing/"
OWNER, DEAD_MAN_MS, PAUSE_MS, EPOCH = "motors", 750, 500, 0 if time.gmtime(0)[0] == 1970 else 946684800
CAPABILITIES = {"drive": {"available": True, "controls": True, "control": True}, "named": NAMED}
CAPABILITIES.update(estop={"available": True, "owners": [OWNER]}, identity=dict(system="pebble", type="robots", id=ID))  # noqa: C408
NONE, UNASKED = {"id": "", "by": "", "device": "", "key": ""}, {"asks": "", "asks_id": ""}
LETTERS, HEX = "abcdefghijklmnopqrstuvwxyz0123456789_-/", "0123456789abcdef"
PLAIN = LETTERS + LETTERS.upper() + " .,:;!?"
now, epoch_ms = time.ticks_ms, lambda: time.time_ns() // 1000000 + EPOCH * 1000  # the counter of ticks wraps
left_ms, token = lambda at: time.ticks_diff(at, now()), lambda size: binascii.hexlify(os.urandom(size)).decode()
later, clamp = lambda ms: time.ticks_add(now(), int(ms)), lambda value, least, most: max(least, min(most, value))
number = lambda value: type(value) in (int, float) and value - value == 0  # noqa: E731 - NaN and infinity are none
letters = lambda of, allowed, size: "".join([one if one in allowed else "_" for one in str(of)[:size]])  # noqa: E731


class Robot:
    def __init__(self):
        self.boot, self.count, self.refused, self.pauses, self.pause_end = token(4), 0, None, False, 0
        self.holder, self.account, self.holds_ms, self.ends = NONE, "", 0, 0  # who drives, and until when
        self.asker, self.asks_end = UNASKED, 0  # who waits for control
        self.end, self.wheels, self.shown = 0, [0, 0], None  # when the wheels stop, and what they do
        self.stop, self.saved = {"latched": False, "recent": [], "by": "", "why": "", "since": 0}, False
        try:
            with open(STOP_FILE) as file:  # OSError: there was no stop yet
                self.stop["latched"] = True  # what cannot be read is one
                self.stop.update(json.load(file))
        except (OSError, ValueError):
            pass

    def publish_stop(self):
        try:
            if not self.saved:
                with open(STOP_FILE + ".new", "w") as file:
                    json.dump(self.stop, file)
                os.rename(STOP_FILE + ".new", STOP_FILE)
                self.saved = True
        except OSError:
            pass  # it is tried again
        self.pause_end = later(PAUSE_MS)  # after saving: what came meanwhile moves nothing
        state = dict(self.stop, boot=self.boot, count=self.count, reset_refused=self.refused, persisted=self.saved)
        publish("estop/" + OWNER, state)

    def turn(self, left, right, ms):  # set your pins here, and for so long
        self.wheels, self.end = [round(left, 3), round(right, 3)], later(ms)

    def drive(self, command, account):
        x, z, valid_ms = command.get("x", 0), command.get("z", 0), command.get("valid_ms", DEAD_MAN_MS)
        if not (number(x) and number(z) and number(valid_ms)):
            return
        x, z = clamp(x, -1, 1), clamp(z, -1, 1)
        mine = self.holder["key"] and (command.get("key"), account) == (self.holder["key"], self.account)
        self.ends = later(self.holds_ms) if mine else self.ends
        if not x and not z:
            self.turn(0, 0, 0)
            self.pauses = self.pauses and not mine and self.holder["key"] != ""  # else the driver has let go
        elif self.pauses:
            self.pause_end = later(PAUSE_MS)  # a stick that is held down moves nothing
        elif not self.stop["latched"] and (mine or ("key" not in command and not NAMED)):
            self.turn(clamp(z + x, -1, 1), clamp(z - x, -1, 1), clamp(valid_ms, 0, DEAD_MAN_MS))

    def halt(self, claims, account):  # whatever arrives is a stop; what has a name counts once
        self.turn(0, 0, 0)
        name = name if len(name := str(claims.get("stop"))) == 16 and letters(name, HEX, 16) == name else token(8)
        if name not in self.stop["recent"]:
            self.count, self.refused, self.saved = self.count + 1, None, False
            by = account[:32] or letters(claims.get("by", ""), PLAIN, 31) + "?" * NAMED  # no broker has checked it
            why, recent = letters(claims.get("why", ""), PLAIN, 40), [name] + self.stop["recent"][:7]  # noqa: RUF005
            self.stop = {"latched": True, "recent": recent, "by": by, "why": why, "since": epoch_ms()}
        self.publish_stop()

    def reset(self, command):  # ends the stop that its sender has seen, and no other
        self.refused = next((one for one in ("boot", "count") if command.get(one) != getattr(self, one)), None)
        if self.refused is None and self.stop["latched"]:
            self.stop["latched"], self.saved, self.pauses = False, False, True
        self.publish_stop()

    def control(self, command, account, take):  # until it ends, is released or taken; who asks meanwhile is shown
        own_id, ms = str(command.get("id")), command.get("for_ms", 3000)
        if len(own_id) != 8 or letters(own_id, HEX + HEX.upper(), 8) != own_id or not number(ms):
            return
        mine, ms = (own_id, account) == (self.holder["id"], self.account), int(clamp(ms, 1000, 10000))
        by = (account + "/" + letters(command.get("by", ""), LETTERS, 40)).strip("/")[:40]
        if command.get("want") == "release":
            self.pass_on(NONE if mine else self.holder)
        elif take or mine or not self.holder["key"]:
            self.account, self.holds_ms, self.ends = account, ms, later(ms)
            new = {"id": own_id, "by": by, "device": letters(command.get("device", ""), LETTERS, 20), "key": token(4)}
            self.pass_on(self.holder if mine else new)
        elif self.asker["asks_id"] in ("", own_id):
            self.asker, self.asks_end = {"asks": by, "asks_id": own_id}, later(ms)

    def pass_on(self, to):
        if to is not self.holder:
            self.holder, self.asker = to, UNASKED
            self.turn(0, 0, 0)

    def tick(self):  # what is over ends, and what has changed is published; after a connection was made, all of it
        if left_ms(self.end) <= 0:
            self.turn(0, 0, 0)
        self.pass_on(self.holder if left_ms(self.ends) > 0 else NONE)
        self.asker = self.asker if left_ms(self.asks_end) > 0 else UNASKED
        self.pauses = self.pauses and left_ms(self.pause_end) > 0
        control = dict(self.holder, named=NAMED, boot=self.boot, **self.asker)
        if self.shown != (self.wheels, control):
            self.shown = self.wheels, control
            publish("status", {"t": epoch_ms(), "value": {"wheels": self.wheels}})
            publish("control/" + OWNER, control)

    def connected(self):
        client.subscribe(IN + "#")
        publish("capabilities", {"t": epoch_ms(), "schema": "pebble-capabilities/v1", "value": CAPABILITIES})
        self.shown = None
        self.publish_stop()

    def receive(self, topic, payload, retained):
        account, metric = "", "" if retained else topic[len(IN) :]  # a kept command is stale
        if metric.startswith("by/"):
            _, account, metric = metric.split("/", 2)
        try:
            value = json.loads(payload)
            value = value["value"] if type(value.get("value")) is dict else value
        except (ValueError, AttributeError, RuntimeError, MemoryError, UnicodeError):
            value = {}  # nothing, but a stop
        if metric == "estop" and payload:
            self.halt(value, account)
        elif metric == "drive-values" and value:
            self.drive(value, account)
        elif metric == "estop-reset" and (account or not NAMED):
            self.reset(value)
        elif metric in ("control", "control/take") and (account or not NAMED):
            self.control(value, account, metric == "control/take")


robot, sign_at, publish = Robot(), now(), lambda metric, value, qos=1: client.publish(OUT + metric, value, qos, True)
will, lost = (OUT + "online", json.dumps({"t": epoch_ms(), "online": False})), lambda: robot.turn(0, 0, 0)
client, wifi = Mqtt(HOST, PORT, f"robot-{ID}", LOGIN, robot.connected, lost, will), network.WLAN(network.STA_IF)
wifi.active(True), wifi.connect(WIFI, WIFI_PASSWORD)
while True:
    for message in client.messages(20):
        robot.receive(*message)
    robot.tick()
    if left_ms(sign_at) <= 0:
        sign_at = later(250)
        publish("online", {"t": epoch_ms()}, 0)

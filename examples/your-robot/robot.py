"""The smallest honest robot, with paho alone:  robot.py ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
With a user it is at level named: only what has the sender's account in its topic moves it, or ends a stop."""

import json, math, os, re, secrets, sys, time
from contextlib import suppress
import paho.mqtt.client as mqtt

ID, HOST, PORT, STOP_FILE, *LOGIN = sys.argv[1:]
NAMED, IN, OUT = bool(LOGIN), f"pebble/robots/{ID}/incoming/", f"pebble/robots/{ID}/outgoing/"
OWNER, DEAD_MAN_S, PAUSE_S, LONGEST = "motors", 0.75, 0.5, 512
CAPABILITIES = {"drive": {"available": True, "controls": True, "control": True}, "named": NAMED}
CAPABILITIES |= {"estop": {"available": True, "owners": [OWNER]}}
CAPABILITIES |= {"identity": {"system": "pebble", "type": "robots", "id": ID}}
FREE = {"latched": False, "recent": [], "by": "", "why": "", "since": 0}
NONE, UNASKED = {"id": "", "by": "", "device": "", "key": ""}, {"asks": "", "asks_id": ""}
now, epoch_ms = time.monotonic, lambda: int(1000 * time.time())


class Robot:
    def __init__(self):
        self.boot, self.count, self.refused, self.paused_at = secrets.token_hex(4), 0, None, -math.inf
        self.holder, self.account, self.holds_s, self.ends = NONE, "", 0.0, 0.0  # who drives, and until when
        self.asker, self.asks_until = UNASKED, 0.0  # who waits for control
        self.until, self.wheels, self.shown = 0.0, [0.0, 0.0], None  # when the wheels stop, and what they do
        self.stop, self.saved = FREE | {"latched": os.path.exists(STOP_FILE)}, False  # what cannot be read is a stop
        with suppress(OSError, ValueError, TypeError):
            self.stop |= json.load(open(STOP_FILE))

    def publish_stop(self):
        if not self.saved:
            self.show(), client.loop_write()  # that the wheels stand: saving may take a while
            with suppress(OSError), open(STOP_FILE + ".new", "w") as file:
                json.dump(self.stop, file), file.flush(), os.fsync(file.fileno())
                os.replace(STOP_FILE + ".new", STOP_FILE)
                self.saved, self.paused_at = True, now()  # what has come meanwhile moves nothing
        state = {"boot": self.boot, "count": self.count, "reset_refused": self.refused, "persisted": self.saved}
        self.publish(f"estop/{OWNER}", self.stop | state)

    def turn(self, left, right, seconds):  # set your pins here, and for so long
        self.wheels, self.until = [round(left, 3), round(right, 3)], now() + seconds

    def drive(self, command, account):
        axes = command.get("x", 0), command.get("z", 0)
        if not all(type(one) in (int, float) and math.isfinite(one) for one in axes):
            return  # NaN is no speed
        x, z = (max(-1.0, min(1.0, one)) for one in axes)
        mine = self.holder["key"] and (command.get("key"), account) == (self.holder["key"], self.account)
        self.ends = max(self.ends, now() + self.holds_s) if mine else self.ends
        if not x and not z:
            self.turn(0.0, 0.0, 0.0)
            self.paused_at = -math.inf if mine or not self.holder["key"] else self.paused_at  # the driver has let go
        elif now() < self.paused_at + PAUSE_S:
            self.paused_at = now()  # a stick that is held down moves nothing
        elif not self.stop["latched"] and (mine or ("key" not in command and not NAMED)):
            seconds = min(DEAD_MAN_S, max(0.0, command.get("valid_ms", 1000 * DEAD_MAN_S) / 1000))
            self.turn(max(-1.0, min(1.0, z + x)), max(-1.0, min(1.0, z - x)), seconds)

    def halt(self, payload, account):  # whatever arrives is a stop; what has a name counts once
        self.turn(0.0, 0.0, 0.0)
        claims = {}
        with suppress(ValueError, TypeError, RecursionError):
            claims = dict(json.loads(payload))
        name = name if re.fullmatch("[0-9a-f]{16}", name := str(claims.get("stop"))) else secrets.token_hex(8)
        if name not in self.stop["recent"]:
            self.count, self.refused, self.saved = self.count + 1, None, False
            by, why = (re.sub(r"[^ !#-\[\]-~]", "_", str(claims.get(one, ""))) for one in ("by", "why"))
            by = account[:32] or by[:31] + "?" * NAMED  # a name that the broker has not checked
            recent = [name, *self.stop["recent"]][:8]
            self.stop = {"latched": True, "recent": recent, "by": by, "why": why[:40], "since": epoch_ms()}
        self.publish_stop()

    def reset(self, command):  # ends the stop that its sender has seen, and no other
        self.refused = "boot" if command["boot"] != self.boot else "count" if command["count"] != self.count else None
        if self.refused is None and self.stop["latched"]:
            self.stop, self.saved, self.paused_at = self.stop | {"latched": False}, False, now()
        self.publish_stop()

    def control(self, command, account, take):  # until it ends, is released or taken; who asks meanwhile is shown
        own_id = re.fullmatch("[0-9A-Fa-f]{8}", command["id"])[0]  # else this changes nothing
        mine = (own_id, account) == (self.holder["id"], self.account)
        seconds = max(1.0, min(10.0, command.get("for_ms", 3000) / 1000))
        by, device = (re.sub("[^a-z0-9_/-]", "_", str(command.get(one, ""))) for one in ("by", "device"))
        new = {"id": own_id, "by": f"{account}/{by}".strip("/")[:40], "device": device[:20]}
        if command.get("want") == "release":
            self.pass_on(NONE if mine else self.holder)
        elif take or mine or not self.holder["key"]:
            self.account, self.holds_s, self.ends = account, seconds, now() + seconds
            self.pass_on(self.holder if mine else new | {"key": secrets.token_hex(4)})
        elif self.asker["asks_id"] in ("", new["id"]):
            self.asker, self.asks_until = {"asks": new["by"], "asks_id": new["id"]}, now() + seconds

    def pass_on(self, to):
        if to is not self.holder:
            self.holder, self.asker = to, UNASKED
            self.turn(0.0, 0.0, 0.0)

    def show(self):  # publishes what has changed; after a connection was made, all of it
        control = self.holder | self.asker | {"named": NAMED, "boot": self.boot}
        if self.shown != (self.wheels, control):
            self.shown = self.wheels, control
            self.publish("status", {"t": epoch_ms(), "value": {"wheels": self.wheels}})
            self.publish(f"control/{OWNER}", control)

    def receive(self, _client, _data, message):
        account, metric = re.fullmatch("(?:by/([^/]*)/)?(.+)", message.topic.removeprefix(IN)).groups("")
        if message.retain:
            return  # a kept command is stale
        if metric == "estop":
            return self.halt(message.payload, account) if message.payload else None
        with suppress(ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            value = json.loads(message.payload) if len(message.payload) <= LONGEST else {}
            value = value["value"] if type(value.get("value")) is dict else value
            if metric == "drive-values":
                self.drive(value, account)
            elif metric == "estop-reset" and (account or not NAMED):
                self.reset(value)
            elif metric in ("control", "control/take") and (account or not NAMED):
                self.control(value, account, metric == "control/take")

    def connected(self, *_):
        client.subscribe(IN + "#", 1)
        self.publish("capabilities", {"t": epoch_ms(), "schema": "pebble-capabilities/v1", "value": CAPABILITIES})
        self.shown = None
        self.publish_stop()

    def publish(self, metric, value, qos=1):
        client.publish(OUT + metric, json.dumps(value), qos, retain=True)


robot, client, heartbeat_at = Robot(), mqtt.Client(mqtt.CallbackAPIVersion.VERSION2), 0.0
if NAMED:
    client.username_pw_set(LOGIN[0], open(LOGIN[1]).read().strip()), client.tls_set(LOGIN[2])
client.will_set(OUT + "online", json.dumps({"t": epoch_ms(), "online": False}), qos=1, retain=True)
client.on_connect, client.on_message = robot.connected, robot.receive
client.connect_async(HOST, int(PORT), keepalive=5)
while True:
    if client.loop(0.02) != mqtt.MQTT_ERR_SUCCESS:
        robot.turn(0.0, 0.0, 0.0)  # connecting may take a while
        time.sleep(0.2)
        with suppress(OSError):
            client.reconnect()
    if now() >= robot.until:
        robot.turn(0.0, 0.0, 0.0)
    if robot.holder["key"] and now() > robot.ends:
        robot.pass_on(NONE)
    robot.asker = robot.asker if now() <= robot.asks_until else UNASKED
    robot.show()
    if now() >= heartbeat_at:
        heartbeat_at = now() + 0.25
        robot.publish("online", {"t": epoch_ms()}, qos=0)

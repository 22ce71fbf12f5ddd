"""The smallest honest robot, with paho alone:  robot.py ID HOST PORT STOP_FILE [USER PASSWORD_FILE]

With a user it is at level named: it takes commands only with the sender's account in the topic.
"""

import json
import math
import os
import re
import secrets
import sys
import time

import paho.mqtt.client as mqtt

ID, HOST, PORT, STOP_FILE = sys.argv[1:5]
USER, PASSWORD = (sys.argv[5], open(sys.argv[6]).read().strip()) if len(sys.argv) > 6 else (None, None)
NAMED = USER is not None
BASE = f"pebble/robots/{ID}"
IN, OUT, OWNER = f"{BASE}/incoming/", f"{BASE}/outgoing/", "motors"
DEAD_MAN_S, PAUSE_S, LONGEST = 0.75, 0.5, 512
CAPABILITIES = {
    "identity": dict(zip(("system", "type", "id"), BASE.split("/"), strict=True)),
    "drive": {"available": True, "controls": True, "topic": IN + "drive-values", "arbitrates": True, "control": True},
    "estop": {"available": True, "topic": IN + "estop", "reset_topic": IN + "estop-reset", "owners": [OWNER],
              "status_topics": [f"{OUT}estop/{OWNER}"]},
}  # fmt: skip
now, epoch_ms = time.monotonic, lambda: int(1000 * time.time())
boot, count, refused, paused_at = secrets.token_hex(4), 0, None, -math.inf
until, wheels, shown = 0.0, [0.0, 0.0], None  # when the wheels stop, and what they do
holder = {"id": "", "by": "", "device": "", "key": "", "ends": 0.0, "account": ""}
try:
    stop = json.load(open(STOP_FILE)) if os.path.exists(STOP_FILE) else {"latched": False, "recent": []}
    assert isinstance(stop["latched"], bool)
except (ValueError, KeyError, TypeError, AssertionError):
    stop = {"latched": True, "recent": [], "why": "the saved state cannot be read"}


def publish(metric, value, retain=True):
    client.publish(OUT + metric, json.dumps(value), qos=1, retain=retain)


def publish_stop():
    with open(STOP_FILE + ".new", "w") as file:
        json.dump(stop, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(STOP_FILE + ".new", STOP_FILE)
    texts = {"by": stop.get("by", ""), "why": stop.get("why", ""), "since": stop.get("since", 0)}
    state = {"boot": boot, "count": count, "reset_refused": refused, "persisted": True, **texts}
    publish(f"estop/{OWNER}", {"latched": stop["latched"], "recent": stop["recent"][:8], **state})


def publish_control():
    shows = {key: holder[key] for key in ("by", "id", "key", "device")}
    publish(f"control/{OWNER}", {**shows, "named": NAMED, "boot": boot})


def turn(left, right, seconds):
    """Motors get this, and nothing after so many seconds: here they are printed, a real robot sets its pins."""
    global wheels, until
    wheels, until = [round(left, 3), round(right, 3)], now() + seconds


def drive(command, account):
    global paused_at
    axes = [command.get(axis) for axis in ("x", "z")]
    numbers = [float(one) if isinstance(one, (int, float, str)) and not isinstance(one, bool) else 0.0 for one in axes]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("no number")
    x, z = (max(-1.0, min(1.0, one)) for one in numbers)
    mine = holder["key"] and holder["key"] in str(command.get("key", "")).split() and account == holder["account"]
    if not x and not z:
        if mine or not holder["key"]:
            paused_at = -math.inf  # who lets go after a reset may drive again
        return turn(0.0, 0.0, 0.0)
    allowed = mine or ("key" not in command and not NAMED)
    if now() < paused_at + PAUSE_S:
        paused_at = now()  # a stick that is held down moves nothing
    elif allowed and not stop["latched"]:
        if mine:
            holder["ends"] = max(holder["ends"], now() + holder["for"])
        valid = command.get("valid_ms", 1000 * DEAD_MAN_S)
        turn(max(-1.0, min(1.0, z + x)), max(-1.0, min(1.0, z - x)), min(DEAD_MAN_S, max(0.0, valid / 1000)))


def halt(payload, account):
    """Whatever arrives here is a stop; what has a name counts once."""
    global count, refused
    try:
        claims = json.loads(payload)
        claims = claims if isinstance(claims, dict) else {}
    except (ValueError, RecursionError):
        claims = {}
    name = claims.get("stop") if re.fullmatch("[0-9a-f]{16}", str(claims.get("stop"))) else secrets.token_hex(8)
    turn(0.0, 0.0, 0.0)
    if name not in stop["recent"]:
        count, refused = count + 1, None
        by, why = (ascii(str(claims.get(key, "")))[1:-1] for key in ("by", "why"))
        stop.update(
            latched=True, recent=[name, *stop["recent"]][:8], by=(account or by)[:32], why=why[:40], since=epoch_ms()
        )
    publish_stop()


def reset(command):
    global refused, paused_at
    refused = "boot" if command["boot"] != boot else "count" if command["count"] != count else None
    if refused is None and stop["latched"]:
        stop["latched"], paused_at = False, now()
    publish_stop()


def control(command, account, take):
    who = account + "@" * bool(account) + re.sub("[^a-z0-9_/-]", "_", str(command.get("by", ""))[:40])
    asker = {
        "id": command["id"],
        "by": who.strip("@"),
        "device": str(command.get("device", ""))[:20],
        "account": account,
    }
    if command.get("want") == "release":
        if asker["id"] == holder["id"]:
            pass_on()
    elif take or not holder["key"] or asker["id"] == holder["id"]:
        lasts = max(1.0, min(10.0, command.get("for_ms", 3000) / 1000))
        if asker["id"] != holder["id"]:
            turn(0.0, 0.0, 0.0)
            holder.update(asker, key=secrets.token_hex(4))
        holder.update({"for": lasts, "ends": now() + lasts})
    publish_control()


def pass_on():
    turn(0.0, 0.0, 0.0)
    holder.update(id="", by="", device="", key="", account="")


def receive(_client, _data, message):
    found = re.fullmatch(f"{IN}(?:by/([a-z0-9_][a-z0-9_-]{{0,31}})/)?(.+)", message.topic)
    if message.retain or found is None:
        return  # a kept command is stale
    account, metric = found[1] or "", found[2]
    try:
        if metric == "estop":
            return halt(message.payload, account) if message.payload else None
        value = json.loads(message.payload) if len(message.payload) <= LONGEST else None
        value = value["value"] if isinstance(value, dict) and isinstance(value.get("value"), dict) else value
        if not isinstance(value, dict):
            return
        if metric == "drive-values":
            drive(value, account)
        elif NAMED and not account:
            return
        elif metric == "estop-reset":
            reset(value)
        elif metric in ("control", "control/take"):
            control(value, account, metric != "control")
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        pass  # what cannot be read changes nothing


def connected(*_):
    for metric in ("estop", "estop-reset", "drive-values", "control", "control/take"):
        client.subscribe([(IN + metric, 1), *([(f"{IN}by/+/{metric}", 1)] if NAMED else [])])
    publish(
        "capabilities", {"t": epoch_ms(), "schema": "pebble-capabilities/v1", "value": {**CAPABILITIES, "named": NAMED}}
    )
    publish_stop(), publish_control()


client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
client.username_pw_set(USER, PASSWORD)
client.will_set(OUT + "online", json.dumps({"t": epoch_ms(), "online": False}), qos=1, retain=True)
client.on_connect, client.on_message = connected, receive
client.connect_async(HOST, int(PORT), keepalive=5)
client.reconnect_delay_set(1, 5)
heartbeat_at = 0.0
while True:
    if client.loop(0.02) != mqtt.MQTT_ERR_SUCCESS:  # the wheels stop without a connection, too
        try:
            client.reconnect()
        except OSError:
            time.sleep(0.2)
    if now() >= until and any(wheels):
        turn(0.0, 0.0, 0.0)
    if wheels != shown:
        print("wheels", *wheels, flush=True)
        publish("status", {"t": epoch_ms(), "value": {"wheels": wheels}})
        shown = wheels
    if holder["key"] and now() > holder["ends"]:
        pass_on()
        publish_control()
    if now() >= heartbeat_at:
        heartbeat_at = now() + 0.25
        client.publish(OUT + "online", json.dumps({"t": epoch_ms()}), qos=0, retain=True)

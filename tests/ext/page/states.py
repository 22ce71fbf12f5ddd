"""States of the operator page, as data: what the server sends it in each of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec

from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe
from tests.ext.boards import mcu_wire as wire
from tests.ext.page.canned import State, Value
from tests.ext.recordings.playing import ms

GOOB, FRED, LAMP, BENJR = (f"pebble/robots/{name}" for name in ("goob", "fred", "minilamp", "benjr"))
TOWER, EVE = "pebble/towers/tower-1", "pebble/people/eve"
GOOB_PATH = f"/r/{GOOB}"
#: What arrives again and again, and how often in seconds.
LIVE = {"web/liveness": 1.0, "online": 1.0, "position": 1.0, "charging-level": 5.0, "sensors/imu": 0.2}
LIVE |= dict.fromkeys(("touch-sensors", "wheel-odometry", "video-overlays"), 0.1)
VIEWER = {"user": "visitor", "role": "viewer", "rights": []}
MAY_TAKE = {"role": "maintainer", "rights": ["drive", "reset", "take", "system"]}

Values = Callable[[int], list[Value]]


def capabilities(kind: str, *, video: bool = True, drive: bool = True) -> dict[str, Any]:
    """The capabilities of a robot as the launcher announces them, without the topics."""
    return {
        "t": 0,
        "schema": "pebble-capabilities/v1",
        "value": {
            "transport": {"kind": kind},
            "video": {"available": video, "controls": video, "encodings": ["h264", "pbvd", "json"]},
            "audio": {"available": video, "controls": video, "encodings": ["pcm", "opus"]},
            "drive": {"available": drive, "controls": drive, "arbitrates": True, "axes": ["x", "z"]},
            "system": {
                "reboot": {"available": True, "controls": drive},
                "service_restart": {"available": True, "controls": drive},
                "git_pull": {"available": True, "controls": False},
            },
            **({"estop": {"available": True, "owners": ["base"]}} if drive else {}),
        },
    }


def liveness(online: bool | None = True, silent_s: float | None = 0.1, **more: Any) -> dict[str, Any]:
    heartbeats = {"latency_ms": 42.0, "average_latency_ms": 48.0, "interval_ms": 250.0, "whole_seconds": False}
    return {"online": online, "silent_s": silent_s} | heartbeats | more


def driver(by: str = "", device: str = "", *, you: bool = False, keeps: bool = True) -> dict[str, Any]:
    more = {"keeps": keeps, "asking": False, "asks": "", "checked": False, "others": False}
    return {"by": by, "device": device, "you": you, "idle_s": None} | more


def estop(now: int, by: str = "", *, sending: str = "", text: str = "", why: str = "button") -> dict[str, Any]:
    """Latched if ``by`` is given."""
    head = {"latched": bool(by), "by": by, "why": why if by else "", "since": now - 95_000 if by else 0}
    owner = {"owner": "base", "boot": "b1", "count": 3, "persisted": True, "reset_refused": None} | head
    sent = {"sending": sending, "sending_text": text, "stop": "00112233445566aa"}
    return {**head, "available": True, "owners": [owner], **sent}


def flow(state: str = "flowing", why: str = "") -> dict[str, Any]:
    sent = {"encoding": "pbvd", "per_second": 10.0, "kbits": 212.0}
    return {"state": state, "why": why, "viewers": 2} | sent


def sound(state: str = "rest", why: str = "", *, talker: str = "") -> dict[str, Any]:
    return {"state": state, "why": why, "encoding": "pcm", "listeners": 1, "talker": talker}


def imu(now: int) -> dict[str, Any]:
    value = {"accel_mps2": {"x": 0.1, "y": -0.2, "z": 9.8}, "gyro_dps": {"x": 0.4, "y": 0.1, "z": 12.3}}
    value |= {"temp_c": 31.5, "orientation_deg": {"roll": 1.2, "pitch": -0.7}, "accel_norm_g": 1.01}
    return {"t": now, "seq": 12, "mcu_ms": 1200, "value": value}


def services(**more: Any) -> dict[str, Any]:
    ready = {"state": "ready", "restarts": 0, "last_exit": None}
    value = {
        "mqtt_bridge": ready,
        "serial_mcu_bridge": ready | {"restarts": 1, "last_exit": "exit code 1"},
        "av_daemon": ready,
        "autonomy_manager": {"state": "restarting", "restarts": 2, "last_exit": "signal 9"},
    }
    return {"t": 0, "value": {"services": value, **more}}


def logs(now: int) -> list[Any]:
    """The log of goob: records, a wrapped one, plain text, and a line that is too long for one row."""
    long = "the reader of the serial line was restarted after a checksum error in frame 0x1f3a; " * 3
    lines = [
        ("INFO", "mqtt_bridge", "connected to broker.example:8883"),
        ("DEBUG", "serial_mcu_bridge", "M 0.600 0.600"),
        ("WARNING", "serial_mcu_bridge", long.strip()),
        ("ERROR", "autonomy_manager", "ended: signal 9"),
        ("WARNING", "launcher", "autonomy_manager is started again in 0.5 s"),
        ("CRITICAL", "autonomy_manager", "<img src=x onerror=alert(1)>"),
    ]
    records = [
        {"t": now - 9000 + 700 * index, "level": level, "service": service, "message": f"[{service}] {text}"}
        for index, (level, service, text) in enumerate(lines)
    ]
    return [*records, {"value": {"t": now, "level": "INFO", "msg": "wrapped"}}, "plain text of an old robot"]


def media(now: int) -> dict[str, Any]:
    camera = {"running": True, "doing": "h264 640x360, 10 fps, 212 kbit/s"}
    return {"t": now, "value": {"camera_publisher": camera, "audio_publisher": {"running": False}}}


def robot(now: int, ref: str, kind: str, volts: float, *, charging: bool = False, video: bool = True) -> list[Value]:
    """What every page receives of one robot."""
    return [
        (ref, "capabilities", capabilities(kind, video=video), 60_000),
        (ref, "web/liveness", liveness(), 100),
        (ref, "online", {"t": now - 100}, 100),
        (ref, "charging-level", {"value": volts, "unit": "v"}, 800),
        (ref, "charging-status", {"value": charging}, 20_000),
        (ref, "web/driver", driver(), 0),
        (ref, "web/estop", estop(now), 0),
    ]


def goob(now: int) -> list[Value]:
    """Goob, with everything that its own page receives."""
    return [
        *robot(now, GOOB, "zenoh", 7.92),
        (GOOB, "web/picture", flow(), 0),
        (GOOB, "web/picture-from", {"source": ""}, 0),
        (GOOB, "web/sound", sound(), 0),
        (GOOB, "sensors/imu", imu(now), 100),
        (GOOB, "touch-sensors", {"value": {"a0": 512, "a1": 498, "a2": 730}, "unit": "adc"}, 20),
        (GOOB, "media-status", media(now), 2000),
        (GOOB, "status", services(), 4000),
        (GOOB, "web/flags", {"remote_mirror": None, "mqtt_audio": False, "mqtt_video": True}, 0),
    ]


def thousand(now: int) -> list[Value]:
    """A thousand robots, of which some are stopped, driven or away; the later ones have the fuller batteries."""
    values = []
    for number in range(1, 1001):
        ref = f"pebble/robots/robot-{number:04d}"
        values += robot(now, ref, "mqtt", 7.2 + 0.001 * number, video=False)
        if number % 97 == 0:
            values.append((ref, "web/estop", estop(now, "eve on phone"), 0))
        if number % 53 == 0:
            values.append((ref, "web/driver", driver("bob", "phone"), 0))
        if number % 41 == 0:
            values.append((ref, "web/liveness", liveness(online=False, silent_s=300.0), 0))
    return values


def fleet(now: int) -> list[Value]:
    """Four robots, one of them off, and three components of other types."""
    lamp = liveness(latency_ms=900.0, whole_seconds=True)
    return [
        (
            "",
            "web/broker",
            {"connected": True, "problem": "", "not_received": "", "robots_omitted": 0, "stops_omitted": False},
            0,
        ),
        *goob(now),
        *robot(now, FRED, "mqtt", 11.8, charging=True),
        (FRED, "autonomy-status", {"running": True, "timestamp": now / 1000, "file": "apriltag-follow"}, 1000),
        *robot(now, LAMP, "mqtt", 3.71, video=False),
        (LAMP, "web/liveness", lamp, 100),
        (BENJR, "capabilities", capabilities("mqtt"), 60_000),
        (BENJR, "web/liveness", liveness(online=False, silent_s=None, latency_ms=None), 0),
        (BENJR, "online", {"t": now - 1_080_000}, 0),
        (BENJR, "charging-level", {"value": 10.4, "unit": "v"}, 1_080_000),
        (TOWER, "capabilities", capabilities("mqtt", drive=False), 60_000),
        (TOWER, "web/liveness", liveness(latency_ms=12.0), 100),
        (TOWER, "web/picture", flow("rest"), 0),
        (EVE, "web/liveness", liveness(latency_ms=80.0), 100),
        (EVE, "status", {"t": now, "value": {"watch": "wrist", "pulse_bpm": 72}}, 900),
    ]


def outlet(
    name: str, *, on: bool = False, bound: bool = True, reachable: bool = True, label: str = ""
) -> dict[str, Any]:
    """What a station reports of one outlet, as its robot publishes it."""
    value = {"bound": bound, "reachable": reachable, "on": on}
    return sample("hs105-sta", f"{name}_state", value, profile="outlet.switch.v1") | ({"label": label} if label else {})


def sample(uid: str, interface: str, value: dict[str, Any], *, profile: str = "") -> dict[str, Any]:
    """What a robot publishes of an interface of a microcontroller."""
    head = {"t": 1_700_000_000_000, "seq": 7, "mcu_ms": 700, "device_uid": uid, "interface": interface}
    return head | {"profile": profile, "value": value}


def described(mcu: wire.M) -> Any:
    """The manifest of a microcontroller as its robot publishes it."""
    return msgspec.to_builtins(parse_describe(mcu.describe()).payload())


_ARM = (wire.F("angle", wire.I16, 0.1, 0.0, "deg"), wire.F("k", wire.F32))
LAMP_MCU = wire.LAMP.but(interfaces=(*wire.LAMP.interfaces, wire.I(5, "arm", wire.IN, wire.KIND_COMMAND, _ARM)))


def devices(now: int) -> list[Value]:
    """Goob with a station of outlets and another microcontroller."""
    listed = [{"name": f"o{n}", "controls": n != 3} for n in range(1, 6)]
    known = capabilities("zenoh")
    known["value"]["outlets"] = {"available": True, "controls": True, "outlets": listed}
    return [
        *fleet(now),
        (GOOB, "capabilities", known, 60_000),
        (GOOB, "outlets/o1/status", outlet("o1", on=True, label="Desk lamp"), 9000),
        (GOOB, "outlets/o2/status", outlet("o2"), 9000),
        (GOOB, "outlets/o3/status", outlet("o3", on=True), 9000),
        (GOOB, "outlets/o4/status", outlet("o4", reachable=False), 9000),
        (GOOB, "outlets/o5/status", outlet("o5", bound=False, reachable=False), 9000),
        (GOOB, "mcu/hs105-sta/describe", described(wire.STATION), 60_000),
        (GOOB, "mcu/hs105-sta/o1_state", outlet("o1", on=True), 9000),
        (GOOB, "mcu/lamp-1/describe", described(LAMP_MCU), 60_000),
        (GOOB, "mcu/lamp-1/lamp", sample("lamp-1", "lamp", {"level": 62.5}), 3000),
        (GOOB, "mcu/lamp-1/glow", sample("lamp-1", "glow", {"lux": 300 + now // 200 % 10 * 7.5}), 20),
        (GOOB, "lights/lamp", sample("lamp-1", "lamp", {"level": 62.5}), 3000),
    ]


def changed(values: Values, *changes: Callable[[int], Value]) -> Values:
    """These values, and others instead of or besides them."""

    def make(now: int) -> list[Value]:
        new = [change(now) for change in changes]
        keys = {value[:2] for value in new}
        return [value for value in values(now) if value[:2] not in keys] + new

    return make


def at(ref: str, metric: str, value: Any, age_ms: float = 0.0) -> Callable[[int], Value]:
    """A value that does not depend on the time."""
    return lambda _now: (ref, metric, value, age_ms)


def stopped(ref: str, by: str, **more: Any) -> Callable[[int], Value]:
    return lambda now: (ref, "web/estop", estop(now, by, **more), 200)


def odometry(seconds: float) -> dict[str, Any]:
    """On a loop of 1.6 m, as the script wheel-odometry publishes it."""
    angle = seconds / 8
    value = {"x_mm": 800 * math.sin(angle), "y_mm": 500 * math.sin(2 * angle), "distance_mm": 100 * seconds}
    value["heading_rad"] = math.atan2(1000 * math.cos(2 * angle), 800 * math.cos(angle))
    return {"value": value, "unit": "mm", "source": "wheel-odometry", "timestamp": seconds}


def attitude(now: int) -> dict[str, Any]:
    """The inertial sensor of a robot that drives on a loop."""
    payload, seconds = imu(now), now / 1000
    payload["value"] |= {
        "gyro_dps": {"x": 2 * math.sin(seconds), "y": math.cos(2 * seconds), "z": 20 * math.sin(seconds / 5)},
        "orientation_deg": {"roll": 3 * math.sin(seconds / 7), "pitch": -2 * math.cos(seconds / 9)},
        "accel_norm_g": 1 + 0.05 * math.sin(3 * seconds),
    }
    return payload


def touch(now: int) -> dict[str, Any]:
    seconds = now / 1000
    value = {f"a{pin}": round(500 + 200 * math.sin(seconds / (pin + 2))) for pin in range(3)}
    return {"value": value, "unit": "adc"}


MINE = at(GOOB, "web/driver", driver("alice", "laptop", you=True))
DRIVING = State(GOOB_PATH, changed(fleet, MINE), LIVE, logs=logs)
#: May restart robots, and is not logged in.
OPERATING = replace(
    DRIVING,
    welcome={
        "user": "local",
        "role": "admin",
        "rights": ["drive", "people", "reset", "system", "take"],
        "login": False,
    },
)

SQUARE = [[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]]
OVERLAYS = {"source": "apriltag-locations", "shapes": [SQUARE], "labels": [{"marker_id": 7, "center_norm": [0.5, 0.5]}]}
#: What the sensors of a robot that drives on a loop report.
MOVING: tuple[Callable[[int], Value], ...] = (
    lambda now: (GOOB, "sensors/imu", attitude(now), 0),
    lambda now: (GOOB, "touch-sensors", touch(now), 0),
    lambda now: (GOOB, "wheel-odometry", odometry(now / 1000), 0),
)
SENSORS = replace(DRIVING, values=changed(fleet, MINE, *MOVING))
STREAM = "http://localhost:{port}"


def with_stream(address: str) -> Callable[[int], Value]:
    """Goob reports a stream of its own."""
    return lambda now: (GOOB, "status", {"t": now, "value": {"webrtc_url": address}}, 100)


NO_BOARD = "cannot open /dev/ttyACM0: No such file or directory"
#: Of goob the motor board is unplugged; of fred it is silent, perhaps by design.
_BOARDS = {
    "serial": {"state": "absent", "why": NO_BOARD},
    "imu": {"state": "ready", "heard_ms": 0},
    "relays": {"state": "silent", "heard_ms": 10_000},
}
UNDRIVEABLE = (
    at(GOOB, "status", services(mcu=_BOARDS, driveable={"state": "no", "why": f"serial: {NO_BOARD}"})),
    at(FRED, "status", services(driveable={"state": "unknown", "why": "serial: its board has sent nothing yet"})),
)

#: The server has recordings.
REPLAYING = State("/replay?days", fleet, LIVE, {"recordings": True}, recordings=True)

SILENT = at(GOOB, "web/liveness", liveness(online=False, silent_s=5.2))
NO_BROKER = {
    "connected": False,
    "problem": "connection refused by 10.0.0.2:8883",
    "not_received": "",
    "robots_omitted": 0,
    "stops_omitted": False,
}
NOT_RECEIVED = "messages come from only 1 of 2 brokers: broker spare.lab:8884 refused us: not authorized"
ONE_BROKER = NO_BROKER | {"connected": True, "problem": "", "not_received": NOT_RECEIVED}
UNCONFIRMED = "base has not confirmed it"
BOB_DRIVES = at(GOOB, "web/driver", driver("bob", "phone", keeps=False))


def keeping(**more: Any) -> Callable[[int], Value]:
    """A robot keeps control itself."""
    return at(GOOB, "web/driver", driver() | more)


EVE_STOPPED = (stopped(GOOB, "eve on phone"), stopped(FRED, "eve on phone"))


def of(path: str, *changes: Callable[[int], Value], base: Values = fleet, **more: Any) -> State:
    """A state with these changes, in which everything that is live arrives."""
    return State(path, changed(base, *changes), **{"repeated": LIVE, **more})


STATES: dict[str, State] = {
    "fleet": of("/", BOB_DRIVES),
    "fleet-stopped": of("/", stopped(GOOB, "eve on phone"), stopped(FRED, "eve on phone", why="button, all")),
    "fleet-undriveable": of("/", *UNDRIVEABLE),
    "fleet-thousand": State("/", thousand),
    "fleet-empty": State("/", lambda _now: []),
    "fleet-lost": State("/", fleet, silent=True),
    "driving": DRIVING,
    "operating": OPERATING,
    "recordings": REPLAYING,
    "replay": replace(REPLAYING, path=f"/replay/{GOOB}?at={ms(30)}"),
    "watching": of(f"{GOOB_PATH}?watch", stopped(FRED, "eve on phone")),
    "free": of(GOOB_PATH),
    "odometry": SENSORS,
    "overlays": of(GOOB_PATH, MINE, at(GOOB, "video-overlays", OVERLAYS), logs=logs),
    "own-stream": of(GOOB_PATH, MINE, with_stream(f"{STREAM}/stream"), logs=logs),
    "taken": of(GOOB_PATH, BOB_DRIVES),
    "kept": of(GOOB_PATH, keeping(by="bob", device="phone"), welcome=MAY_TAKE),
    "kept-and-asked": of(GOOB_PATH, keeping(by="bob", device="phone", asking=True, others=True), welcome=MAY_TAKE),
    "others-ask": of(GOOB_PATH, keeping(by="alice", you=True, asks="otto")),
    "others-drive": of(GOOB_PATH, keeping(by="alice", you=True, others=True)),
    "viewer": of(GOOB_PATH, welcome=VIEWER),
    "stopped": of(GOOB_PATH, MINE, *EVE_STOPPED),
    "stop-sent": of(GOOB_PATH, MINE, stopped(GOOB, "", sending="sent", text=UNCONFIRMED)),
    "stop-old": of(f"/r/{LAMP}", stopped(LAMP, "", sending="old", text="it has no emergency stop")),
    "not-confirmed": of(
        GOOB_PATH, MINE, stopped(GOOB, "", sending="not confirmed", text=f"{UNCONFIRMED}: it may be off")
    ),
    "lost": State(GOOB_PATH, changed(fleet, MINE), silent=True, freezes=True),
    "no-broker": of(GOOB_PATH, MINE, at("", "web/broker", NO_BROKER)),
    "one-broker": of(GOOB_PATH, MINE, at("", "web/broker", ONE_BROKER)),
    "silent": of(GOOB_PATH, MINE, SILENT, repeated={}, pictures=False),
    "old-picture": replace(DRIVING, freezes=True),
    "no-picture": of(GOOB_PATH, MINE, at(GOOB, "web/picture", flow("starting")), logs=logs, pictures=False),
    "devices": of(GOOB_PATH, MINE, base=devices, repeated={**LIVE, "mcu/lamp-1/glow": 0.2}),
    "devices-viewer": of(GOOB_PATH, base=devices, welcome=VIEWER),
    "no-camera": of(f"/r/{LAMP}"),
}


# -- lights, sounds and scripts


def asked(**sections: Any) -> Callable[[int], Value]:
    """Goob with what can be asked of it; ``sections`` are changed ones of its capabilities."""
    offered = {"available": True, "controls": True}
    more = {"lights": {"solid": True, "flash": True}, "soundboard": offered, "autonomy": offered} | sections
    known = capabilities("zenoh")
    return at(GOOB, "capabilities", known | {"value": known["value"] | more}, 60_000)


def setting(key: str, label: str, kind: str, default: Any = None, **more: Any) -> dict[str, Any]:
    return {"key": key, "label": label, "type": kind, "default": default, "arg": f"--{key}"} | more


FOLLOW = [
    setting("tag_id", "Tag ID", "int", min=0, max=34, step=1, required=True),
    setting("distance_m", "Distance (m)", "float", 0.6, min=0.2, max=3.0),
    setting("search", "Search", "bool", True),
    setting("family", "Family of the tags", "enum", "APRILTAG_25H9", options=["APRILTAG_25H9", "APRILTAG_36H11"]),
    setting("topic", "Topic", "string", ""),
]
SCRIPTS = {
    "files": [
        {"file": "apriltag-follow", "label": "Follow a tag", "configs": FOLLOW},
        {"file": "wheel-odometry", "label": "Wheel odometry", "configs": []},
    ],
    "controls": True,
    "timestamp": 1.0,
}
_SPOKEN = (f"speech/number {n}.wav" for n in range(140))
CLIPS = {
    "files": ["horn.wav", "intro.mp3", *_SPOKEN, "warn/siren, long and loud.wav"],
    "controls": True,
    "timestamp": 1.0,
}


def script(now: int, **more: Any) -> Value:
    """Goob's running script."""
    config = {"tag_id": 5, "distance_m": 0.6, "search": True, "family": "APRILTAG_36H11"}
    parts = [{"file": "wheel-odometry", "pid": 812, "running": True}]
    status = {"running": True, "file": "apriltag-follow", "pid": 813, "dependencies": parts, "error": None}
    status |= {"config": config, "timestamp": now / 1000, "controls": True}
    return (GOOB, "autonomy-status", status | more, 4000)


def clip(**more: Any) -> Callable[[int], Value]:
    return at(GOOB, "soundboard-status", {"playing": False, "file": None, "error": None, "timestamp": 1.0} | more, 2000)


ASKED = changed(
    fleet,
    asked(),
    at(GOOB, "soundboard-files", CLIPS, 9000),
    at(GOOB, "autonomy-files", SCRIPTS, 9000),
    clip(),
    at(GOOB, "autonomy-status", {"running": False, "timestamp": 1.0, "error": None}, 9000),
)
NOT_ARBITRATED = asked(drive={"available": True, "controls": True})
STATES |= {
    "asked": of(GOOB_PATH, MINE, base=ASKED),
    "asked-busy": of(
        GOOB_PATH,
        MINE,
        lambda now: script(now, overridden=True),
        clip(playing=True, file="speech/number 3.wav"),
        base=ASKED,
    ),
    "script-drives": of(GOOB_PATH, MINE, NOT_ARBITRATED, lambda now: script(now), base=ASKED),
}
STATES["map-silent"] = replace(SENSORS, values=changed(fleet, *MOVING, SILENT), repeated={}, pictures=False)
#: All cards that goob has.
STATES["full"] = replace(SENSORS, values=changed(ASKED, MINE, *MOVING))

"""States of the operator page, as data: what the server sends it in each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tests.web.canned import State, Value

GOOB, FRED, LAMP, BENJR = (f"pebble/robots/{name}" for name in ("goob", "fred", "minilamp", "benjr"))
TOWER, EVE, SAT = "pebble/towers/tower-1", "pebble/people/eve", "pebble/satellites/cube-3"
GOOB_PATH = f"/r/{GOOB}"

#: What arrives again and again, and how often in seconds.
LIVE = {
    "web/liveness": 1.0,
    "sensors/imu": 0.2,
    "touch-sensors": 0.1,
    "charging-level": 5.0,
    "online": 1.0,
    "position": 1.0,
}
VIEWER = {"user": "visitor", "role": "viewer", "rights": []}

Values = Callable[[int], list[Value]]


def capabilities(kind: str, *, video: bool = True, drive: bool = True) -> dict[str, Any]:
    """Of a robot as the launcher announces them, without the topics."""
    return {
        "t": 0,
        "schema": "pebble-capabilities/v1",
        "value": {
            "transport": {"kind": kind},
            "video": {"available": video, "controls": video, "encodings": ["h264", "pbvz", "pbvd", "json"]},
            "audio": {"available": video, "controls": video, "encodings": ["pcm", "opus"]},
            "drive": {"available": drive, "controls": drive, "arbitrates": True},
            **({"estop": {"available": True, "owners": ["base"]}} if drive else {}),
        },
    }


def liveness(online: bool | None = True, silent_s: float | None = 0.1, **more: Any) -> dict[str, Any]:
    return {"online": online, "silent_s": silent_s, "latency_ms": 42.0, "whole_seconds": False} | more


def driver(by: str = "", device: str = "", *, you: bool = False, server: str = "") -> dict[str, Any]:
    return {"by": by, "device": device, "server": server, "you": you, "idle_s": None}


def estop(now: int, by: str = "", *, sending: str = "", text: str = "", why: str = "button") -> dict[str, Any]:
    """Latched if ``by`` is given."""
    owner = {
        "owner": "base",
        "latched": bool(by),
        "boot": "b1",
        "count": 3,
        "by": by,
        "why": why if by else "",
        "since": now - 95_000 if by else 0,
        "persisted": True,
        "reset_refused": None,
    }
    head = {key: owner[key] for key in ("latched", "by", "why", "since")}
    return {
        **head,
        "available": True,
        "owners": [owner],
        "sending": sending,
        "sending_text": text,
        "stop": "00112233445566aa",
    }


def flow(state: str = "flowing", why: str = "") -> dict[str, Any]:
    return {
        "state": state,
        "why": why,
        "encoding": "pbvz",
        "per_second": 10.0,
        "kbits": 212.0,
        "viewers": 2,
        "pinned": "",
    }


def sound(state: str = "rest", why: str = "", *, talker: str = "") -> dict[str, Any]:
    return {"state": state, "why": why, "encoding": "pcm", "listeners": 1, "talker": talker}


def imu(now: int) -> dict[str, Any]:
    vector = {"x": 0.1, "y": -0.2, "z": 9.8}
    value = {
        "accel_mps2": vector,
        "gyro_dps": {"x": 0.4, "y": 0.1, "z": 12.3},
        "temp_c": 31.5,
        "orientation_deg": {"roll": 1.2, "pitch": -0.7},
        "accel_norm_g": 1.01,
    }
    return {"t": now, "seq": 12, "mcu_ms": 1200, "value": value}


def services() -> dict[str, Any]:
    value = {
        "mqtt_bridge": {"state": "ready", "restarts": 0, "last_exit": None},
        "serial_mcu_bridge": {"state": "ready", "restarts": 1, "last_exit": "exit code 1"},
        "av_daemon": {"state": "ready", "restarts": 0, "last_exit": None},
        "autonomy_manager": {"state": "restarting", "restarts": 2, "last_exit": "signal 9"},
    }
    return {"t": 0, "value": {"services": value}}


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
    ]


def fleet(now: int) -> list[Value]:
    """Four robots, one of them off, and three components of other types."""
    lamp = liveness(latency_ms=900.0, whole_seconds=True)
    return [
        ("", "web/broker", {"connected": True, "problem": "", "robots_omitted": 0}, 0),
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


def satellite(now: int) -> list[Value]:
    """A component of a type that this page does not know, beside the fleet."""
    position = {"t": now, "value": {"lat_deg": 52.1, "lon_deg": 13.4, "alt_km": 412.5, "mode": "sun pointing"}}
    return [
        *fleet(now),
        (SAT, "web/liveness", liveness(latency_ms=640.0), 100),
        (SAT, "status", position, 300),
        (SAT, "diagnostics", {"value": {"panels": [4.1, 4.2, 0.0], "safe_mode": False, "uptime_s": 86213}}, 1500),
        (SAT, "charging-level", {"value": 81.0, "unit": "%"}, 2500),
    ]


MINE = at(GOOB, "web/driver", driver("alice", "laptop", you=True))
DRIVING = State(GOOB_PATH, changed(fleet, MINE), LIVE)

STATES: dict[str, State] = {
    "fleet": State("/", changed(fleet, at(GOOB, "web/driver", driver("bob", "phone"))), LIVE),
    "fleet-stopped": State(
        "/", changed(fleet, stopped(GOOB, "eve on phone"), stopped(FRED, "eve on phone", why="button, all")), LIVE
    ),
    "fleet-empty": State("/", lambda _now: []),
    "fleet-lost": State("/", fleet, silent=True),
    "driving": DRIVING,
    "free": State(GOOB_PATH, fleet, LIVE),
    "taken": State(GOOB_PATH, changed(fleet, at(GOOB, "web/driver", driver("bob", "phone"))), LIVE),
    "viewer": State(GOOB_PATH, fleet, LIVE, VIEWER),
    "stopped": State(
        GOOB_PATH, changed(fleet, MINE, stopped(GOOB, "eve on phone"), stopped(FRED, "eve on phone")), LIVE
    ),
    "stop-sent": State(
        GOOB_PATH, changed(fleet, MINE, stopped(GOOB, "", sending="sent", text="base has not confirmed it")), LIVE
    ),
    "stop-old": State(
        f"/r/{LAMP}",
        changed(fleet, stopped(LAMP, "", sending="old", text="it has no emergency stop")),
        LIVE,
    ),
    "not-confirmed": State(
        GOOB_PATH,
        changed(
            fleet, MINE, stopped(GOOB, "", sending="not confirmed", text="base has not confirmed it: it may be off")
        ),
        LIVE,
    ),
    "lost": State(GOOB_PATH, changed(fleet, MINE), silent=True, freezes=True),
    "no-broker": State(
        GOOB_PATH,
        changed(
            fleet,
            MINE,
            at(
                "",
                "web/broker",
                {"connected": False, "problem": "connection refused by 10.0.0.2:8883", "robots_omitted": 0},
            ),
        ),
        LIVE,
    ),
    "silent": State(
        GOOB_PATH,
        changed(fleet, MINE, at(GOOB, "web/liveness", liveness(online=False, silent_s=5.2))),
        {},
        pictures=False,
    ),
    "old-picture": replace(DRIVING, freezes=True),
    "no-picture": replace(
        DRIVING, pictures=False, values=changed(fleet, MINE, at(GOOB, "web/picture", flow("starting")))
    ),
    "listening": replace(DRIVING, values=changed(fleet, MINE, at(GOOB, "web/sound", sound("flowing", talker="bob")))),
    "no-sound": replace(
        DRIVING,
        values=changed(
            fleet, MINE, at(GOOB, "web/sound", sound("refused", "its sound cannot be switched on from here"))
        ),
    ),
    "old-page": replace(DRIVING, welcome={"version": "of another server"}),
    "plain-http": replace(DRIVING, welcome={"drives": False}),
    "tower": State(f"/r/{TOWER}", fleet, LIVE),
    "person": State(f"/r/{EVE}", fleet, LIVE),
    "satellite": State(f"/r/{SAT}", satellite, LIVE),
    "no-camera": State(f"/r/{LAMP}", fleet, LIVE),
    "other-camera": replace(
        DRIVING,
        values=changed(fleet, MINE, at(GOOB, "web/picture-from", {"source": TOWER}), at(TOWER, "web/picture", flow())),
    ),
}

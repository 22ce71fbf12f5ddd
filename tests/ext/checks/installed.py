"""A scratch root with an installed robot that nothing runs: made by the parts of Pebble that write these files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pebble.config import load
from pebble.extensions.fleet import applying, certificates
from pebble.extensions.fleet.broker_files import conf_text
from pebble.extensions.fleet.folder import Fleet, Server
from pebble.extensions.fleet.folder import load as load_fleet
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Account, Role
from pebble.extensions.operator.places import Places
from pebble.motion.latch import Latch
from pebble.motors.state_file import StateFile

PAGE, MQTT, ROBOT = "sentinel of the page", "sentinel-of-mqtt", "sentinel-of-the-robot"
BROKER = Path("etc/mosquitto/pebble")
PEOPLE = Path("srv/page/people.sqlite")
STOP = "00000000000000c3"

CONFIG = {
    "robot": {"id": "goob"},
    "transport": {"kind": "zenoh"},
    "services": {
        "mqtt_bridge": {
            "enabled": True,
            "remote_mqtt": {"host": "127.0.0.1", "username": "goob", "password_file": "mqtt.password"},
        },
        "recorder": {"folder": "/var/lib/pebble/recordings"},
        "serial_mcu_bridge": {"enabled": True, "serial": {"port": "/dev/ttyACM0"}},
        "web_handler": {"enabled": True},
    },
    "web_interface": {
        "people": f"/{PEOPLE}",
        "tls": {"certificate": "tls/server.pem", "key": "tls/server.key", "ca": "tls/ca.pem"},
        "mqtt": {"host": "127.0.0.1", "username": "page", "password": MQTT},
    },
}


@contextmanager
def installed(root: Path) -> Iterator[Places]:
    """It is there for the block: the page's database is open meanwhile, with changes in its journal."""
    places = Places(root)
    state = (places.state / "recordings", (root / PEOPLE).parent)
    for folder in (places.etc, *state, root / BROKER, places.broker.parent):
        folder.mkdir(parents=True)
    _write(places.etc / "mqtt.password", f"{ROBOT}\n")
    _write(places.config, json.dumps(CONFIG))
    _write(places.state / "recordings/1.mcap", "large")
    certificates.init(places.etc / "tls", ["goob.local"])
    fleet = Fleet(level="named", brokers=(Server(host="127.0.0.1"),))
    fleet = fleet.with_account("goob", Account(roles=("robot",), bases=("pebble/robots/goob",)))
    applying.make(root / BROKER, fleet, {"goob": ROBOT})
    _write(places.broker, conf_text(load_fleet(root / BROKER), Path("/", BROKER), "mosquitto"))
    _write(places.etc / "camera_calibration.yaml", "%YAML:1.0\n---\nimage_width: 640\n")
    _write(places.etc / "auto_tune_state.json", json.dumps({"current_values": {"left_mm_per_event": 19.1}}))
    latch = Latch("boot", 8, int.__sub__)
    latch.stop(STOP, "ann", "a dog", 1)
    stop = StateFile(config_of(places).state_file("estop-serial"))
    stop.save(latch.saved())
    stop.close()
    people = People(root / PEOPLE)
    people.add("ann", PAGE, Role.ADMIN)
    try:
        yield places
    finally:
        people.close()


def config_of(places: Places):  # type: ignore[no-untyped-def]
    return load(places.config, {**os.environ, "STATE_DIRECTORY": str(places.state)})


def _write(file: Path, text: str) -> None:
    file.write_text(text)
    file.chmod(0o640)

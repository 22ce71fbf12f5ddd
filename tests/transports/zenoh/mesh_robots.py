"""Robots at a mesh of hubs, as a process: `main(endpoints, names, fleet)`. Each sends ten heartbeats a second."""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from pathlib import Path

from pebble.fleet.certificates import ACCOUNTS, CA_CERT
from pebble.transports import Message, QoS, TlsSettings, ZenohSettings, create

HEARTBEAT = "pebble/robots/{}/outgoing/online"
WILL = b"WILL"
PERIOD_S = 0.1


def certificate_of(fleet: Path, account: str) -> TlsSettings:
    certificate, key = (fleet / ACCOUNTS / f"{account}.{ending}" for ending in ("pem", "key"))
    return TlsSettings(ca_cert=fleet / CA_CERT, client_cert=certificate, client_key=key)


def settings_of(run_dir: Path, endpoints: tuple[str, ...], account: str, fleet: Path | None) -> ZenohSettings:
    """Return those of a client; ``fleet``: the folder of one, with the certificate of ``account``."""
    if fleet is None:
        return ZenohSettings(run_dir=run_dir, connect=endpoints, client=True)
    tls = certificate_of(fleet, account)
    return ZenohSettings(run_dir=run_dir, connect=endpoints, client=True, tls=tls, account=account)


def main(endpoints: str, names: str, fleet: str = "") -> None:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        place, at = Path(fleet) if fleet else None, tuple(endpoints.split(","))
        robots, slowest = {}, 0.0
        for name in names.split(","):
            will = Message(HEARTBEAT.format(name), WILL, QoS.DELIVERED, retain=True)
            began = time.monotonic()
            robots[name] = create("zenoh", name, settings_of(Path(folder), at, name, place), will=will).open(20)
            slowest = max(slowest, time.monotonic() - began)
        sys.stdout.write(f"{slowest}\n")
        sys.stdout.flush()
        ended = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
        number = 0
        while not ended.wait(PERIOD_S):
            number += 1
            for name, robot in robots.items():
                robot.publish(HEARTBEAT.format(name), b"%d" % number, qos=QoS.DELIVERED, retain=True)
        for robot in robots.values():
            robot.close()

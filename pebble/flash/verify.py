"""Does the freshly flashed robot live? Hears its first heartbeat at the broker, or its first report on the line."""

from __future__ import annotations

import json
import queue
import time
from contextlib import closing, suppress

import serial

from pebble.config import Config
from pebble.contract import ONLINE
from pebble.errors import LinkError
from pebble.flash.boards import Firmware
from pebble.links import LOCAL_RECONNECT_S, mqtt_settings
from pebble.transports import Message, QoS, State, create

BROKER_S = 5.0
HEARTBEAT_S = 60.0  # boot, Wi-Fi, a lease, a name
REPORT_S = 20.0
_CHUNK = 4096


def at_broker(config: Config, timeout_s: float = HEARTBEAT_S) -> str:
    """Wait for a live heartbeat; the kept one is an older life's. Raises LinkError that says what to look at."""
    broker = config.local_mqtt
    heard: queue.Queue[Message] = queue.Queue()
    settings = mqtt_settings(broker, reconnect_max_s=LOCAL_RECONNECT_S)
    transport = create("mqtt", f"{config.base}-flash", settings)
    with closing(transport.open(BROKER_S)):
        if transport.state is not State.CONNECTED:
            why = transport.problem or f"no answer within {BROKER_S:g} s"
            raise LinkError(f"local_mqtt: this machine cannot reach {broker.host}:{broker.port} to listen: {why}")
        transport.subscribe(ONLINE.topic(config.base), heard.put, qos=QoS.LATEST)
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0:
            with suppress(queue.Empty):
                message = heard.get(timeout=left)
                if not message.retain and _alive(message.payload):
                    return "it is online"
    raise LinkError(
        f"no heartbeat of {config.base} within {timeout_s:g} s: are the Wi-Fi's name and password right, is it a "
        f"2.4 GHz network, does it lead to {broker.host}?"
    )


def _alive(payload: bytes) -> bool:
    try:
        body = json.loads(payload)
    except ValueError:
        return False
    return isinstance(body, dict) and body.get("online") is not False


def on_line(port: str, firmware: Firmware, timeout_s: float = REPORT_S) -> str:
    """Wait for the firmware's report on its serial line. Raises LinkError with what came instead."""
    is_report = firmware.is_report
    assert is_report is not None  # noqa: S101 - robots with a broker are heard there
    end = time.monotonic() + timeout_s
    heard = b""
    while time.monotonic() < end:
        # the port vanishes while the board resets
        with suppress(OSError, serial.SerialException), serial.Serial(port, firmware.baud, timeout=0.1) as line:
            while time.monotonic() < end:
                heard = (heard + line.read(line.in_waiting or 1))[-_CHUNK:]
                if is_report(heard):
                    return "it reports"
        time.sleep(0.1)
    raise LinkError(f"--port {port}: no report of {firmware.name} within {timeout_s:g} s; it said {heard[-200:]!r}")

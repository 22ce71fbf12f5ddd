"""Verifies a flashed robot: waits for its first heartbeat at the broker, or its first report on the serial line."""

import queue
import time
from contextlib import closing, suppress

import serial

from pebble.config import Config
from pebble.contract import ONLINE, codec
from pebble.errors import DeviceError, PayloadError
from pebble.extensions.install.flash.boards import Firmware
from pebble.runtime.connections import LOCAL_RECONNECT_S, mqtt_settings
from pebble.transports import Message, QoS, State, create

BROKER_S = 5.0
HEARTBEAT_S = 60.0  # boot, Wi-Fi, DHCP, DNS
REPORT_S = 20.0
_CHUNK = 4096


def at_broker(config: Config, timeout_s: float = HEARTBEAT_S) -> str:
    """Return a line about the first live heartbeat; retained ones are older than the reset. Raises DeviceError."""
    broker = config.local_mqtt
    received: queue.Queue[Message] = queue.Queue()
    settings = mqtt_settings(broker, reconnect_max_s=LOCAL_RECONNECT_S)
    transport = create("mqtt", f"{config.base}/flash", settings)
    with closing(transport.open(BROKER_S)):
        if transport.state is not State.CONNECTED:
            why = transport.problem or f"no answer within {BROKER_S:g} s"
            raise DeviceError(f"local_mqtt: this machine cannot connect to {broker.host}:{broker.port}: {why}")
        transport.subscribe(ONLINE.topic(config.base), received.put, qos=QoS.LATEST)
        end = time.monotonic() + timeout_s
        while (remaining_s := end - time.monotonic()) > 0:
            with suppress(queue.Empty):
                message = received.get(timeout=remaining_s)
                if not message.retain and _is_heartbeat(message.payload):
                    return "the robot is online"
    raise DeviceError(
        f"no heartbeat from {config.base} within {timeout_s:g} s: check that the Wi-Fi's name and password are right, "
        f"that it is a 2.4 GHz network, and that {broker.host} can be reached from it"
    )


def _is_heartbeat(payload: bytes) -> bool:
    """True if this is a heartbeat, not the will of an earlier connection."""
    with suppress(PayloadError):
        return codec.decode(ONLINE, payload).online is not False
    return False


def on_serial_port(port: str, firmware: Firmware, timeout_s: float = REPORT_S) -> str:
    """Return a line about the firmware's first report. Raises DeviceError with what was received instead."""
    is_report = firmware.is_report
    assert is_report is not None  # noqa: S101 - robots with a broker are verified there
    end = time.monotonic() + timeout_s
    received = b""
    while time.monotonic() < end:
        # the port disappears while the board resets
        with suppress(OSError, serial.SerialException), serial.Serial(port, firmware.baud, timeout=0.1) as line:
            while time.monotonic() < end:
                received = (received + line.read(line.in_waiting or 1))[-_CHUNK:]
                if is_report(received):
                    return "the robot sends reports"
        time.sleep(0.1)
    raise DeviceError(
        f"--port {port}: no report from {firmware.name} within {timeout_s:g} s; received {received[-200:]!r}"
    )

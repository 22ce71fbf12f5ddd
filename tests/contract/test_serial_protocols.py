"""A protocol of serial lines is written once: its row is what the config, the service and the errors go by."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
from pathlib import Path
from typing import Literal
from pebble.contract import serial_protocols as table
row = table.SerialProtocol("pebble.services.serial_mcu_bridge.text.imu_bridge:ImuBridge", drives=True)
table.SERIAL_PROTOCOLS["lamp_v1"] = row
table.SerialProtocolName = Literal[tuple(table.SERIAL_PROTOCOLS)]
for name in list(sys.modules):  # what has read the table without the row is imported again
    if name.startswith("pebble") and not name.startswith(("pebble.contract", "pebble.errors")):
        del sys.modules[name]

from pebble.config import parse
from pebble.config.schema import keys_text, schema_text
from pebble.errors import ConfigError
from pebble.launcher.capabilities import capabilities
from pebble.runtime.addresses import Addresses
from pebble.services.serial_mcu_bridge.serial_service import bridge_of

def config(protocol):
    line = {"enabled": True, "protocol": protocol, "serial": {"port": "/dev/lamp"}}
    return parse({"robot": {"id": "r"}, "services": {"serial_mcu_bridge": line}}, folder=Path("/"), env={})

lamp = config("lamp_v1")
print(bridge_of(lamp).__name__)
print(capabilities(lamp, Addresses(lamp))["drive"]["available"])
print(schema_text().count('"lamp_v1"'))
print(keys_text().count('or "lamp_v1"') > 0)
try:
    config("lamp")
except ConfigError as error:
    print(error)
"""


def test_a_new_row_is_all_that_a_protocol_needs_besides_its_service() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    bridge, drives, in_schema, in_docs, error = done.stdout.splitlines()
    assert (bridge, drives, in_schema, in_docs) == ("ImuBridge", "True", "1", "True")
    assert "services.serial_mcu_bridge.protocol" in error
    assert '"lamp_v1"' in error

"""The broker of scripts that speak MQTT: it signs their drive commands and passes everything else to the robot's."""

from pebble.services.autonomy_manager.gate.gate import Gate as Gate

"""The broker of scripts that speak MQTT: it signs their drive commands and passes everything else to the robot's."""

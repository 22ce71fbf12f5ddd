"""The serial lines to a robot's microcontrollers: one process per serial port, one service ("bridge") per protocol.

serial_service.py  the base of all bridges; ``pebble/contract/serial_protocols.py`` lists them by protocol
line/              the open port, lines that wait to be sent, and the stop that is sent first and last
text/              the protocol goob_base_v1 of motor boards, and their bridge: motor_bridge.py
imu/               inertial sensors, with lines of text (imu_mpu6050_v1) or on self-describing MCUs
pebble_serial_v1/  the protocol of MCUs that describe themselves, without I/O; docs/ext/serial-protocol.md
devices/           such MCUs as parts of a robot, and their bridge: described_bridge.py
"""

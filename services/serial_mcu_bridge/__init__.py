"""The serial lines to a robot's microcontrollers: one process per serial port, one service ("bridge") per protocol.

``serial_service.py`` is the base of all bridges; ``pebble/contract/serial_protocols.py`` lists them by protocol.
``line/``              the open port, what waits to be sent, and the stop that is sent first and last
``motion/``            which commands may move the motors: emergency stop, people before scripts, deadlines
``text/``              goob_base_v1 (its bridge: motor_bridge.py) and imu_mpu6050_v1 (imu_bridge.py)
``pebble_serial_v1/``  the protocol of MCUs that describe themselves, without I/O; docs/ext/boards.md describes it
``devices/``           such MCUs as parts of a robot, and their bridge: described_bridge.py
"""

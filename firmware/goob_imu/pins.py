"""The wiring of Goob's second XIAO SAMD21: an MPU-6050, and the serial line to the robot's computer.

The line is the USB port if the board's MicroPython can use it for bytes, that is if it has select and
sys.stdin.buffer. The official image has neither (1.29: MICROPY_HW_CODESIZE is 184 KB, so SAMD21_EXTRA_FEATURES is 0 in
ports/samd/mcu/samd21/mpconfigmcu.h); there the line is the serial port on D6 and D7, see common/uart.py.
"""

SCL, SDA = "PA09", "PA08"  # D5, D4
IMU = 0x68  # AD0 low

"""The wiring of BenJr's LOLIN (WEMOS) D1 mini: GPIO numbers, and 0 for the only analogue input."""

SCL = 5  # D1
SDA = 4  # D2
MOTOR_SHIELD = 0x30  # I2C address: both jumpers, AD0 and AD1, closed
BATTERY = 0  # A0

# The battery's voltage at a full reading. The ADC measures 1 V; the D1 mini puts 220 over 100 kOhm in front of it, the
# battery shield another 130 (its jumper J2 closed): 4.5 V. To calibrate, multiply this by the voltage of a meter over
# the voltage that the robot reports.
BATTERY_FULL_V = 4.5

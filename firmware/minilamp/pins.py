"""The wiring of MiniLAMP's Seeed XIAO ESP32C6: GPIO numbers.

D0..D10 are GPIO 0, 1, 2, 21, 22, 23, 16, 17, 19, 20, 18 (espressif/arduino-esp32, variants/XIAO_ESP32C6). Only D0..D2
have an ADC. D6 and D7 are unused: the boot loader sends on GPIO 16 and pulls GPIO 17 up, so motors would twitch.
"""

LEFT = (1, 2)  # D1, D2 to AIN1, AIN2 of the first DRV8833; in1 driven is forward
RIGHT = (21, 22)  # D3, D4 to BIN1, BIN2 of the first
GROUSERS = (19, 20)  # D8, D9 to AIN1, AIN2 of the second
BATTERY = 0  # D0, behind the divider

# The battery's voltage at a full reading: 3.3 V times the divider, here two equal resistors. To calibrate, multiply
# this by the voltage of a meter over the voltage that the robot reports.
BATTERY_FULL_V = 6.6

# The antenna switch: low on 3 powers it, low on 14 is the antenna on the board (wiki.seeedstudio.com, XIAO ESP32C6)
ANTENNA = (3, 14)

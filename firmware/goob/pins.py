"""The wiring of Goob's motor board, a Seeed XIAO SAMD21. Names are the MCU's own, valid for every MicroPython.

A PWM pin outputs one channel of a timer, and pins on one channel output the same signal. MicroPython assigns the
first timer of a pin that is unused, else its first timer (ports/samd/pin_af.c, get_pwm_config). So the order in which
robot.py makes the signals matters: right motor, headlights, left motor.

    D10 PA06 TCC1 channel 0    D8 PA07 TCC1 channel 1    right motor
    D2  PA10 TCC0 channel 2 (TCC1 channel 0 is its first choice, but the right motor has TCC1)    headlights
    D1  PA04 TCC0 channel 0    D9 PA05 TCC0 channel 1    left motor

(ports/samd/mcu/samd21/pin-af-table.csv, boards/SEEED_XIAO_SAMD21/pins.csv). The ADC's reference is half the supply
and its gain is 1, so it reads 0 .. 1.65 V (MICROPY_HW_ADC_VREF 2 in the board's mpconfigboard.h): the hall sensors,
which swing from 0 to 3.3 V, need a divider by two. D4 and D5 (I2C) are free.
"""

RIGHT = ("PA06", "PA07")  # DRV8833 BIN1, BIN2; mounted the other way round
LED = "PA10"  # both headlights, by a transistor
LEFT = ("PA04", "PA05")  # DRV8833 AIN1, AIN2
SENSORS = ("PA02", "PB09", "PA11")  # A0, A7, A3: left wheel, right wheel, left wheel a quarter of a wave later
BATTERY = "PB08"  # A6
BATTERY_FULL_V = 9.9  # at 1.65 V: divider 100 kΩ over 20 kΩ
PWM_HZ = 1000  # of everything: a timer has one frequency

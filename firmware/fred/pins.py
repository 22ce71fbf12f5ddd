"""The wiring of Fred's motor board, a Seeed XIAO SAMD21: all eleven pins. Names are the MCU's own.

Fred needs seven PWM signals and the header has six timer channels. So the two inputs of a motor, of which only one
is ever driven, share one: PA04 and PA08 are both on channel 0 of TCC0, PA05 and PA09 on channel 1 (see robot.py).
MicroPython assigns the first timer of a pin that is unused, else its first timer (ports/samd/pin_af.c, get_pwm_config).
So the order in which robot.py makes the signals matters: red, green, blue, then the motors.

    D10 PA06 TCC1 channel 0    red
    D2  PA10 TCC0 channel 2    green
    D3  PA11 TCC1 channel 1    blue
    D1  PA04, D4 PA08 TCC0 channel 0    left motor
    D9  PA05, D5 PA09 TCC0 channel 1    right motor

(ports/samd/mcu/samd21/pin-af-table.csv, boards/SEEED_XIAO_SAMD21/pins.csv.) The ADC reads 0 .. 1.65 V
(MICROPY_HW_ADC_VREF 2 in the board's mpconfigboard.h); D0, D6 and D7 have no PWM but can measure.
"""

LEFT = ("PA04", "PA08")  # DRV8833 AIN1, AIN2
RIGHT = ("PA05", "PA09")  # DRV8833 BIN1, BIN2
LED = ("PA11", "PA10", "PA06")  # blue, green, red
SENSORS = ("PA02", "PB08", "PB09")  # A0, A6, A7: three touch pads
CHARGE = "PA07"  # D8, high on the charger
PWM_HZ = 1000  # of everything: a timer has one frequency

"""Where the XIAO SAMD21 of a station of switched sockets is wired: to a relay board for each of them.

D6 and D7 are free: without USB they are the serial line, see common/uart.py.
"""

#: For each outlet the input of its relay, and a wire to its board's supply: low, or nothing there, means no relay
OUTLETS = (
    ("PA02", "PA04"),  # D0, D1
    ("PA10", "PA11"),  # D2, D3
    ("PA08", "PA09"),  # D4, D5
    ("PA07", "PA05"),  # D8, D9
)

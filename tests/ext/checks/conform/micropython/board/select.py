"""MicroPython's select, as far as the sample uses it: for one socket."""

import host

POLLIN = 1


class poll:  # noqa: N801 - its name in MicroPython
    def register(self, socket, events):
        pass

    def poll(self, ms):
        return [(None, POLLIN)] if host.wait(ms) else []

"""MicroPython's select, as far as the samples use it: one poll is for a socket or for the console."""

import sys

import host

POLLIN = 1


class poll:  # noqa: N801 - its name in MicroPython
    def register(self, stream, events):
        self._ready = host.typed if stream is sys.stdin else host.wait

    def poll(self, ms):
        return [(None, POLLIN)] if self._ready(ms) else []

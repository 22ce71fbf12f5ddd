"""MicroPython's socket, as far as the sample uses it: it is connected as soon as it is to wait no more."""

import binascii

import host


class socket:  # noqa: N801 - its name in MicroPython
    def __init__(self):
        self._left, self._dialled = b"", False

    def settimeout(self, seconds):
        pass

    def connect(self, address):
        self._address = address

    def setblocking(self, blocking):
        if not self._dialled:
            self.dial("")

    def dial(self, ca):
        self._dialled = True
        if not host.dial(*self._address, ca):
            raise OSError("no connection")

    def read(self, size):
        """None: nothing is there yet; empty: the connection has ended."""
        if not self._left:
            more = host.read()
            if more == "-":
                return None
            self._left = binascii.unhexlify(more)
        found, self._left = self._left[:size], self._left[size:]
        return found

    def write(self, data):
        host.write(binascii.hexlify(data).decode())
        return len(data)

    def close(self):
        host.close()


def getaddrinfo(name, port):
    return [(2, 1, 0, "", (name, port))]

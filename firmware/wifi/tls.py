"""TLS around a connected socket, for boards whose MicroPython has it. A driver.

Later reads and writes perform the handshake, so nothing blocks on the network. Its arithmetic still takes some hundred
milliseconds of processor time: it only happens while the motors are off.
"""

import ssl
import time

import machine


class Wrapper:
    """A wrapper of sockets in TLS. ``options``: true, or {"ca": a DER file on the board, "server_name": ...}."""

    def __init__(self, options: bool | dict) -> None:
        self._ca = None if options is True else options.get("ca")  # type: ignore[union-attr]  # not False
        self._name = "" if options is True else options.get("server_name", "")  # type: ignore[union-attr]
        self.host = ""  # as it is named in the settings, of the next connection

    def set_time(self, epoch_ms: int) -> None:
        """Set the board's clock, if the time is known: certificates are valid for a limited time (docs, library/ssl).

        A time server that reports 2065 or later is wrong, and gmtime of some ports fails from 2068 on.
        """
        if self._ca and 1_000_000_000_000 < epoch_ms < 3_000_000_000_000:
            since = 946684800 if time.gmtime(0)[0] == 2000 else 0  # ports count from 2000 or from 1970
            year, month, day, hour, minute, second, weekday, _ = time.gmtime(epoch_ms // 1000 - since)
            machine.RTC().datetime((year, month, day, weekday, hour, minute, second, 0))

    def __call__(self, plain):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        if self._ca:
            with open(self._ca, "rb") as file:
                context.load_verify_locations(cadata=file.read())
            context.verify_mode = ssl.CERT_REQUIRED  # type: ignore[attr-defined]  # not in the stub
        else:
            context.verify_mode = ssl.CERT_NONE  # type: ignore[attr-defined]
        return context.wrap_socket(plain, server_hostname=self._name or self.host, do_handshake_on_connect=False)

"""Being on the Wi-Fi, and getting back to it, without waiting. A driver."""

import network
from micropython import const

from common.ticks import diff

_AGAIN_MS = const(15_000)  # a port's own attempt may take ten seconds


class Wifi:
    """``step`` every turn."""

    def __init__(self, ssid: str, password: str) -> None:
        self._login = ssid, password
        self._tried: int | None = None
        self._server = ""
        network.WLAN(network.AP_IF).active(False)  # an ESP8266 starts with an open door
        self._wlan = network.WLAN(network.STA_IF)
        self._wlan.active(True)
        self._wlan.config(pm=network.WLAN.PM_NONE)  # a sleeping receiver lets commands wait for 100 ms and more

    def step(self, now: int) -> str:
        """The address of the server that knows names; "": not on the Wi-Fi."""
        if self._wlan.isconnected():
            self._tried = now
            self._server = self._server or self._wlan.ifconfig()[3]
            return self._server
        self._server = ""
        if self._tried is None or diff(now, self._tried) >= _AGAIN_MS:
            self._tried = now
            try:
                self._wlan.disconnect()
                self._wlan.connect(*self._login)
            except OSError:  # busy with an attempt of its own
                pass
        return ""

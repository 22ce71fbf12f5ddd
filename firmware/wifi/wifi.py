"""Connects to the Wi-Fi, and again after a loss, without blocking. A driver."""

import network
from micropython import const

from common.ticks import diff

_AGAIN_MS = const(15_000)  # a port's own attempt may take ten seconds


class Wifi:
    """The station interface. Call ``step`` every turn."""

    def __init__(self, ssid: str, password: str) -> None:
        self._login = ssid, password
        self._tried: int | None = None  # when it was last connected, or last tried to be
        self._server = ""  # the DNS server, while connected
        network.WLAN(network.AP_IF).active(False)  # an ESP8266 starts an open access point
        self._wlan = network.WLAN(network.STA_IF)
        self._wlan.active(True)
        self._wlan.config(pm=network.WLAN.PM_NONE)  # power save would delay commands by 100 ms and more

    def step(self, now: int) -> str:
        """Return the address of the DNS server; "" while not connected to the Wi-Fi."""
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

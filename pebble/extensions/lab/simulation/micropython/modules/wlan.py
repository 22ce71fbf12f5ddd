"""The ``network`` module of a simulated board: a Wi-Fi station whose access point can disappear and come back."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final

Platform = str  # "esp32" or "esp8266"

JOIN_S = 0.3  # to a known network: scan of one channel, handshake and DHCP
ADDRESS: Final = ("10.0.0.42", "255.255.255.0", "10.0.0.1", "10.0.0.53")  # own, mask, gateway, name server


class Radio:
    """The station of one board. ``lose`` and ``restore`` move its access point; the firmware uses the rest.

    ``rejoins``: the driver joins again by itself, as MicroPython does on ESP32 and ESP8266 by default.
    """

    def __init__(self, now: Callable[[], float], platform: Platform) -> None:
        self.platform: Platform = platform
        self.join_s, self.rejoins = JOIN_S, True
        self._now = now
        self._active = self._wanted = False
        self._in_range = True
        self._joined_at = float("inf")

    def lose(self) -> None:
        """Take the access point out of range."""
        self._in_range, self._joined_at = False, float("inf")
        self._wanted = self._wanted and self.rejoins

    def restore(self) -> None:
        """Bring the access point back into range. A station that is joining has joined after ``join_s``."""
        if not self._in_range:
            self._in_range = True
            self._join()

    @property
    def connected(self) -> bool:
        return self._now() >= self._joined_at

    def activate(self, on: bool) -> None:
        self._active = on
        if not on:
            self.disconnect()

    def connect(self) -> None:
        """Start to join. Raises OSError if inactive; on an ESP32 also while an attempt is in progress."""
        if not self._active or (self.platform == "esp32" and self._wanted and not self.connected):
            raise OSError("Wifi Internal Error" if self._active else "Wifi Not Started")
        self._wanted, self._joined_at = True, float("inf")
        self._join()

    def disconnect(self) -> None:
        self._wanted, self._joined_at = False, float("inf")

    def _join(self) -> None:
        if self._wanted and self._in_range:
            self._joined_at = self._now() + self.join_s


class Wlan:
    """MicroPython's WLAN object of the station interface."""

    IF_STA, IF_AP = 0, 1
    PM_NONE = 0

    def __init__(self, radio: Radio) -> None:
        self._radio = radio

    def active(self, on: bool) -> None:
        self._radio.activate(on)

    def connect(self, ssid: str | None = None, key: str | None = None, **_more: Any) -> None:
        if not (ssid is None or isinstance(ssid, str)) or not (key is None or isinstance(key, str)):
            raise TypeError("can't convert to str")
        self._radio.connect()

    def disconnect(self) -> None:
        self._radio.disconnect()

    def isconnected(self) -> bool:
        return self._radio.connected

    def ifconfig(self) -> tuple[str, str, str, str]:
        return ADDRESS if self._radio.connected else ("0.0.0.0", "0.0.0.0", "0.0.0.0", "0.0.0.0")  # noqa: S104

    def config(self, **values: Any) -> None:
        """Do nothing: power saving has no visible effect."""


def network_module(radio: Radio) -> SimpleNamespace:
    """Return the module ``network`` of one board, with ``radio`` as its station. A board is no access point."""
    never_joins = Radio(lambda: 0.0, radio.platform)  # its clock stands still
    interfaces = {Wlan.IF_STA: Wlan(radio), Wlan.IF_AP: Wlan(never_joins)}

    def wlan(interface: int = Wlan.IF_STA) -> Wlan:  # a function, as each call returns the one object of an interface
        return interfaces[interface]

    wlan.PM_NONE = Wlan.PM_NONE  # type: ignore[attr-defined]  # firmware takes WLAN for a class, and reads WLAN.PM_NONE
    return SimpleNamespace(WLAN=wlan, STA_IF=Wlan.IF_STA, AP_IF=Wlan.IF_AP)

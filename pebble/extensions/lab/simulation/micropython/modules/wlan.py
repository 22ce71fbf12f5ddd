"""The ``network`` module of a simulated board: a Wi-Fi station whose access point can be lost and come back."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final

Platform = str  # "esp32" or "esp8266"

JOIN_S = 0.3  # to a known network: scan of one channel, handshake and DHCP
ADDRESS: Final = ("10.0.0.42", "255.255.255.0", "10.0.0.1", "10.0.0.53")  # own, mask, gateway, name server

_IDLE, _CONNECTING, _LOST, _GONE, _JOINED = "idle", "connecting", "lost", "gone", "joined"
_STATUS: Final[dict[str, dict[str, int]]] = {  # the numbers of each MicroPython port
    "esp32": {_IDLE: 1000, _CONNECTING: 1001, _LOST: 200, _GONE: 201, _JOINED: 1010},
    "esp8266": {_IDLE: 0, _CONNECTING: 1, _LOST: 3, _GONE: 3, _JOINED: 5},
}


class Radio:
    """The station of one board. ``lose`` and ``restore`` move its access point; the firmware uses the rest.

    ``rejoins``: the driver rejoins by itself, as both ports do by default.
    """

    def __init__(
        self, now: Callable[[], float], platform: Platform, *, join_s: float = JOIN_S, rejoins: bool = True
    ) -> None:
        self.platform: Platform = platform
        self.join_s, self.rejoins = join_s, rejoins
        self._now = now
        self._active = self._wanted = self._lost = False
        self._in_range = True
        self._joined_at = float("inf")

    def lose(self) -> None:
        """Take the access point out of range."""
        self._in_range, self._joined_at, self._lost = False, float("inf"), True
        self._wanted = self._wanted and self.rejoins

    def restore(self) -> None:
        """Bring the access point back; a station that is joining has joined after ``join_s``."""
        if not self._in_range:
            self._in_range = True
            self._join()

    @property
    def connected(self) -> bool:
        return self._now() >= self._joined_at

    @property
    def status(self) -> int:
        return _STATUS[self.platform][self._state()]

    def activate(self, on: bool) -> None:
        self._active = on
        if not on:
            self.disconnect()

    @property
    def active(self) -> bool:
        return self._active

    def connect(self) -> None:
        """Start to join. Raises OSError if inactive and, on an ESP32, while an attempt is in progress."""
        if not self._active or (self.platform == "esp32" and self._wanted and not self.connected):
            raise OSError("Wifi Internal Error" if self._active else "Wifi Not Started")
        self._wanted, self._lost, self._joined_at = True, False, float("inf")
        self._join()

    def disconnect(self) -> None:
        self._wanted, self._joined_at = False, float("inf")

    def _join(self) -> None:
        if self._wanted and self._in_range:
            self._joined_at = self._now() + self.join_s

    def _state(self) -> str:
        if not self._wanted:
            return _LOST if self._lost else _IDLE
        if self._in_range:
            return _JOINED if self.connected else _CONNECTING
        return _LOST if self._lost else _GONE


class Wlan:
    """MicroPython's WLAN object of the station interface."""

    IF_STA, IF_AP = 0, 1
    PM_NONE, PM_PERFORMANCE, PM_POWERSAVE = 0, 1, 2

    def __init__(self, radio: Radio, uid: bytes) -> None:
        self._radio = radio
        self._config: dict[str, Any] = {"mac": uid[:6].ljust(6, b"\0"), "pm": self.PM_PERFORMANCE, "reconnects": -1}

    def active(self, on: bool | None = None) -> bool:
        if on is not None:
            self._radio.activate(on)
        return self._radio.active

    def connect(self, ssid: str | None = None, key: str | None = None, **_more: Any) -> None:
        if not (ssid is None or isinstance(ssid, str)) or not (key is None or isinstance(key, str)):
            raise TypeError("can't convert to str")
        self._radio.connect()

    def disconnect(self) -> None:
        self._radio.disconnect()

    def isconnected(self) -> bool:
        return self._radio.connected

    def status(self, what: str | None = None) -> int:
        if what == "rssi":
            return -55
        if what is not None:
            raise ValueError("unknown status param")
        return self._radio.status

    def ifconfig(self) -> tuple[str, str, str, str]:
        return ADDRESS if self._radio.connected else ("0.0.0.0", "0.0.0.0", "0.0.0.0", "0.0.0.0")  # noqa: S104

    def config(self, *names: str, **values: Any) -> Any:
        if values:
            self._config.update(values)
            self._radio.rejoins = self._config["reconnects"] != 0 and self._radio.rejoins
            return None
        (name,) = names
        if name not in self._config:
            raise ValueError("unknown config param")
        return self._config[name]


def network_module(radio: Radio, uid: bytes = b"") -> SimpleNamespace:
    """Make the module ``network`` of one board; its station is ``radio``, and its own access point is never used."""
    interfaces = {Wlan.IF_STA: Wlan(radio, uid), Wlan.IF_AP: Wlan(Radio(lambda: 0.0, radio.platform), uid)}

    def wlan(interface: int = Wlan.IF_STA) -> Wlan:
        if interface not in interfaces:
            raise ValueError("invalid WLAN interface identifier")
        return interfaces[interface]

    for name in ("IF_STA", "IF_AP", "PM_NONE", "PM_PERFORMANCE", "PM_POWERSAVE"):
        setattr(wlan, name, getattr(Wlan, name))
    return SimpleNamespace(
        WLAN=wlan,
        STA_IF=Wlan.IF_STA,
        AP_IF=Wlan.IF_AP,
        STAT_IDLE=_STATUS[radio.platform][_IDLE],
        STAT_CONNECTING=_STATUS[radio.platform][_CONNECTING],
        STAT_GOT_IP=_STATUS[radio.platform][_JOINED],
        STAT_NO_AP_FOUND=_STATUS[radio.platform][_GONE],
    )

"""The line protocols a robot's config can name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Protocol

from pebble.services.serial_mcu_bridge import goob_base


class MotorProtocol(Protocol):
    """What the bridge needs of a protocol that drives motors; a module can be one. See goob_base for the meaning."""

    @property
    def STOP(self) -> bytes: ...  # noqa: N802 - a constant of the module
    def parse(self, line: bytes) -> list[goob_base.Report]: ...
    def mix(self, x: float, z: float) -> tuple[float, float]: ...
    def drive_line(self, left: float, right: float) -> bytes: ...
    def lights_line(self, blue: float, green: float, red: float) -> bytes: ...
    def flash_line(self, blue: float, green: float, red: float, period_s: float) -> bytes: ...


#: The config's ``protocol`` to its implementation.
PROTOCOLS: Final[Mapping[str, MotorProtocol]] = {"goob_base_v1": goob_base}

"""An inertial sensor that says nothing hangs: then the process ends, and the launcher starts it again."""

from __future__ import annotations

from pebble.config import SerialBridge

TIMEOUT_S = 5.0
FIRST_S = 2.0  # later may the first sample be: the board boots, and is asked what it is
_INSTANCE = "imu"  # an instance of this name is one, whatever it speaks


class ImuWatchdog:
    """Counts the time without a sample while there is a device to wait for. The clock is passed in."""

    def __init__(self, options: SerialBridge, instance: str) -> None:
        self._configured = options.health.imu_sample_timeout_seconds
        self._is_imu = options.protocol.startswith("imu_") or instance == _INSTANCE
        self._since: float | None = None  # the newest sample, or the opening of the line

    @property
    def timeout_s(self) -> float:
        """0 for never."""
        if self._configured is not None:
            return self._configured
        return TIMEOUT_S if self._is_imu else 0.0

    def found_imu(self) -> None:
        """The device turned out to be one."""
        self._is_imu = True

    def begin(self, now: float) -> None:
        self._since = now + FIRST_S

    def end(self) -> None:
        """There is no device."""
        self._since = None

    def sample(self, now: float) -> None:
        if self._since is not None:
            self._since = now

    def expired(self, now: float) -> bool:
        return self.timeout_s > 0 and self._since is not None and now - self._since > self.timeout_s

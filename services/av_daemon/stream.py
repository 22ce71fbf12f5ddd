"""One stream: a device and its writer. A device that hangs is abandoned, and opened again."""

import logging
import time
from collections.abc import Callable

from msgspec.structs import replace

from pebble.contract.payloads import MediaReport
from pebble.extensions.media.frames import FrameWriter
from pebble.services.av_daemon.capturer import Capturer
from pebble.services.av_daemon.health import FIRST_DELAY_S, Asked, Health
from pebble.services.av_daemon.source import Source

log = logging.getLogger(__name__)

REST_S = 5.0  # without a reader, until the device is closed
_HUNG_LIMIT = 3  # threads whose device never answers, before no more are started


class Stream:
    """The stream. All methods are for the service's thread. Call ``poll`` now and then.

    ``first_delay_s``, ``asked``: see :class:`Health`; ``rest_s``: without a reader, until the device is closed.
    """

    def __init__(
        self,
        name: str,
        writer: FrameWriter,
        open_source: Callable[[], Source],
        *,
        first_delay_s: float = FIRST_DELAY_S,
        rest_s: float = REST_S,
        asked: Asked | None = None,
    ) -> None:
        self.name, self._writer, self._open_source, self._rest_s = name, writer, open_source, rest_s
        self._health = Health(first_delay_s, asked)
        self._told: frozenset[str] = frozenset()  # kinds of problems that were logged, and last
        self._capturer = self._start(0.0)
        self._hung: list[Capturer] = []  # abandoned threads that have not ended, as their device does not answer

    def poll(self, now: float) -> None:
        """Abandon a device that is overdue, and open it again in another thread; log problems of its frames."""
        self._tell(self._health.problems)
        self._hung = [capturer for capturer in self._hung if capturer.alive]
        if len(self._hung) >= _HUNG_LIMIT or not self._health.overdue(now):
            return
        self._capturer.end()
        self._hung.append(self._capturer)
        delay = self._health.failed("the device does not answer")
        log.warning("%s: the device does not answer; it is opened again in %g s", self.name, delay)
        self._capturer = self._start(delay)

    def _tell(self, problems: dict[str, str]) -> None:
        for kind in problems.keys() - self._told:
            log.warning("%s: it %s", self.name, problems[kind])
        if self._told and not problems:
            log.info("%s: what it gives is as it should be again", self.name)
        self._told = frozenset(problems)

    def report(self, now: float) -> MediaReport:
        report = self._health.report(now)
        return replace(
            report,
            readers=self._writer.readers,
            fallbacks=self._writer.counters["fallbacks"],
            last_error=report.last_error or self._writer.problem or None,
        )

    def end(self) -> None:
        """Begin to release the device, without waiting."""
        self._capturer.end()

    def join(self, timeout: float = 0.5) -> None:
        """Wait until the device is released. A device that hangs is left until the process ends."""
        deadline = time.monotonic() + timeout
        for capturer in (self._capturer, *self._hung):
            if not capturer.join(max(0.0, deadline - time.monotonic())):
                log.warning("%s: its device does not answer; left to the end of the process", self.name)

    def _start(self, wait_s: float) -> Capturer:
        return Capturer(self.name, self._writer, self._open_source, self._health, rest_s=self._rest_s, wait_s=wait_s)

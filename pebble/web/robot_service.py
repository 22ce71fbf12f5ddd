"""The operator page as a process of the robot: ``python -m pebble.web.robot_service CONFIG``."""

import asyncio
import logging
import signal
import sys

from pebble.client.page.packages import require_packages
from pebble.client.page.settings import WebSettings
from pebble.config import config_of_process
from pebble.errors import PebbleError
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier, set_log_level, set_up_logging
from pebble.runtime.process import exit_at_the_latest
from pebble.web.ready_settings import ready_settings_of

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    set_up_logging("INFO")
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m pebble.web.robot_service CONFIG\n")
        return 2
    try:
        config = config_of_process(arguments[0])
        set_log_level(config.log_level_of("web_handler"))
        settings = ready_settings_of(config)
        require_packages()
        return _Page(settings).run()
    except PebbleError as error:
        for line in str(error).splitlines():
            log.error("%s", line)
        return 1
    except Exception:  # the process boundary: log why, exit non-zero, be restarted
        log.exception("web_handler ended unexpectedly")
        return 1


class _Page:
    """Serves the page until SIGTERM, and notifies the launcher while its event loop is alive."""

    def __init__(self, settings: WebSettings) -> None:
        self._settings = settings
        self._notify = Notifier()
        self._ended = self._served = False
        self._alive: asyncio.Task[None] | None = None

    def run(self) -> int:
        from pebble.web.serve import run  # of packages that may be missing

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        code = run(self._settings, on_ready=self._ready)
        return code if self._served else 1

    def _end(self, _signal: int, _frame: object) -> None:
        """Called before the server has its own handlers, and by the server when it has ended."""
        self._ended = True
        exit_at_the_latest()

    def _ready(self, url: str) -> None:
        self._served = True
        log.info("the operator page is at %s", url)
        self._notify.ready()
        self._alive = asyncio.get_running_loop().create_task(self._report())
        if self._ended:
            signal.raise_signal(signal.SIGTERM)

    async def _report(self) -> None:
        while True:
            self._notify.alive()
            await asyncio.sleep(ALIVE_PERIOD_S)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

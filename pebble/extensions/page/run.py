"""The operator page as a process of a robot: ``python -m pebble.extensions.page.run CONFIG``."""

import asyncio
import logging
import signal
import sys

from pebble.config import Config, config_of_process
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.fleet.people import has_user
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.page.config import WebInterface
from pebble.extensions.page.setting import WebSettings, has_login, people_of, settings_of
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier, set_log_level, set_up_logging
from pebble.runtime.process import exit_at_the_latest

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    set_up_logging("INFO")
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m pebble.extensions.page.run CONFIG\n")
        return 2
    try:
        settings = _settings_of_process(arguments[0])
        require_packages()
        return _Page(settings).run()
    except PebbleError as error:
        for line in str(error).splitlines():
            log.error("%s", line)
        return 1
    except Exception:  # the process boundary: log why, exit non-zero, be restarted
        log.exception("web_handler ended unexpectedly")
        return 1


def settings_or_all_problems(config: Config) -> WebSettings:
    """Return the settings of the page. Raises ConfigError.

    The error names all problems at once, also that no user exists. Without another problem that is no error here:
    callers check it themselves.
    """
    try:
        return settings_of(config)
    except ConfigError as error:
        try:
            missing_user = _problem_of_users(config)
        except PebbleError as other:
            missing_user = [str(other)]
        raise ConfigError([*error.problems, *missing_user]) from None


def _settings_of_process(path: str) -> WebSettings:
    """Return the settings of a usable page. Raises ConfigError with everything that is missing."""
    config = config_of_process(path)
    set_log_level(config.log_level)
    settings = settings_or_all_problems(config)
    if problems := _problem_of_users(config):
        raise ConfigError(problems)
    return settings


def _problem_of_users(config: Config) -> list[str]:
    """Return the problem that a login is needed and no user exists; empty if there is none."""
    file = people_of(config)
    if not has_login(config.section(WebInterface)) or has_user(file):
        return []
    return [
        f"web_interface.people: {file} has no user: run `pebble web user add NAME --people {file}` as the user who "
        "runs the robot"
    ]


class _Page:
    """A server of the page until SIGTERM; it notifies the launcher while its event loop runs."""

    def __init__(self, settings: WebSettings) -> None:
        self._settings, self._notify = settings, Notifier()
        self._ended = self._served = False
        self._alive: asyncio.Task[None] | None = None

    def run(self) -> int:
        from pebble.extensions.page.serve import run  # of packages that may be missing

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        code = run(self._settings, on_ready=self._ready)
        return code if self._served else 1

    def _end(self, _signal: int, _frame: object) -> None:
        """End the server, whichever stage of its start or end it has reached."""
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

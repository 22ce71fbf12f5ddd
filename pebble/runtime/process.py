"""The outermost lines of a service process: arguments, logging, signals, and notes to the launcher.

To run one service by itself: ``python -m pebble.runtime.process MODULE:CLASS CONFIG [INSTANCE]``.
"""

from __future__ import annotations

import logging
import signal
import sys

from msgspec.structs import replace

from pebble.config import Config, config_of_process
from pebble.errors import ConfigError, PebbleError
from pebble.extension import part
from pebble.runtime.connections import local_transport
from pebble.runtime.environment import withhold
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier, Reported, set_log_level, set_up_logging
from pebble.runtime.service import Service
from pebble.transports import State

_STOP_DEADLINE_S = 3.0

log = logging.getLogger(__name__)


def run(service_class: type[Service], arguments: list[str] | None = None) -> int:
    """Run a service as this process, with the arguments ``CONFIG [INSTANCE]``; return the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not 1 <= len(arguments) <= 2:
        sys.stderr.write(f"{service_class.name} needs the arguments CONFIG [INSTANCE]\n")
        return 2
    instance = arguments[1] if len(arguments) == 2 else ""
    set_up_logging("INFO")
    try:
        config = config_of_process(arguments[0])
        withhold(config.password_variables)  # from the programs that the service starts
        set_log_level(config.log_level)
        return _serve(service_class, view_of(config, instance), instance)
    except PebbleError as error:
        for line in str(error).splitlines():
            log.error("%s", line)
        return 1
    except Exception:  # the process boundary: log why, exit non-zero, be restarted
        log.exception("%s ended unexpectedly", service_class.name)
        return 1


def _serve(service_class: type[Service], config: Config, instance: str) -> int:
    name = f"{service_class.name}-{instance}" if instance else service_class.name
    transport = local_transport(config, service_class.client_name or name, as_published=service_class.as_published)
    service = service_class(config, transport, instance=instance)
    notify = Notifier()
    local = Reported(notify.local)

    def quit_(_signal: int, _frame: object) -> None:
        exit_at_the_latest()
        service.quit()

    def alive() -> None:
        notify.alive()
        connected = transport.state is State.CONNECTED
        local.report(connected, "" if connected else transport.problem)

    signal.signal(signal.SIGTERM, quit_)
    signal.signal(signal.SIGINT, quit_)
    service.timers.add(service.clock(), alive, period=ALIVE_PERIOD_S)
    service.run(ready=notify.ready)
    return 0


def view_of(config: Config, instance: str) -> Config:
    """Return the config as the process of a serial line sees it: its entry replaces the section of all lines."""
    if not instance:
        return config
    instances = config.serial_instances()
    if instance not in instances:
        raise ConfigError(f'services.serial_mcu_bridge.instances: there is no enabled instance "{instance}"')
    return replace(config, services=replace(config.services, serial_mcu_bridge=instances[instance]))


def exit_at_the_latest() -> None:
    """End the process after 3 s even if stopping hangs. Hardware that moves also has its own deadline.

    The kernel ends the process: this is called in signal handlers, where starting a thread may wait for ever.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, _STOP_DEADLINE_S)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python -m pebble.runtime.process MODULE:CLASS CONFIG")
    sys.exit(run(part(sys.argv[1]), sys.argv[2:]))

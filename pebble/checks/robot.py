"""Checks of the robot on this machine, by its config. They change nothing; an unreachable broker takes seconds."""

import os
from collections.abc import Iterator
from pathlib import Path

from pebble.checks import devices, media
from pebble.checks.broker.of_config import brokers, page_brokers
from pebble.checks.check import SOON_DAYS, Check, CheckResult, failed, ok, run, warn
from pebble.checks.machine import MACHINE
from pebble.checks.recorder import recorder
from pebble.checks.who import who_drives
from pebble.client.page import require_packages, settings_of
from pebble.config import LAUNCHER_LOCK, Config
from pebble.errors import PebbleError
from pebble.fleet import certificates
from pebble.runtime.parent import launcher_runs


def run_checks(config: Config | None) -> Iterator[CheckResult]:
    """Check this machine, and ``config``'s robot on it."""
    yield from (result for _, result in run(MACHINE, None))
    if config is None:
        return
    yield from (warn(warning, what="config") for warning in config.warnings)
    if config.robot.platform == "linux":
        yield from (result for _, result in run(ROBOT, config))


def state_directory(path: Path) -> CheckResult:
    """Find a place where an emergency stop cannot be saved: it would end with a power cut."""
    existing = next(folder for folder in (path, *path.parents) if os.access(folder, os.F_OK))
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return warn(
            f"{path} cannot be written: an emergency stop ends with a power cut",
            f"sudo install -d -m 700 -o $USER {path}, or set transport.state_dir",
        )
    return ok(str(path) if existing == path else f"{path} will be created")


def config_of_running(config: Config) -> Iterator[CheckResult]:
    """Find a file that has changed since the robot was started with it."""
    lock = config.run_dir() / LAUNCHER_LOCK
    if config.path is None or not launcher_runs(config.run_dir()):
        return
    if config.path.stat().st_mtime > lock.stat().st_mtime:
        yield warn(f"{config.path} has changed since the robot read it", "start the robot again")
    else:
        yield ok(f"{config.path}, as the robot runs")


def operator_page(config: Config) -> Iterator[CheckResult]:
    """Check that the page that the robot itself serves can start; if it has users, only its own user can read that."""
    if not config.services.web_handler.enabled:
        return
    try:
        settings = settings_of(config)
        require_packages()
    except PebbleError as error:
        yield failed(str(error))  # which says what to do
        return
    if settings.login and settings.certificate is None:
        yield warn("is not encrypted: passwords can be read", "pebble cert init")
    else:
        yield ok(f"port {settings.port} of {settings.host}")
    if settings.certificate is None:
        return
    try:
        days = certificates.show(settings.certificate).days_left
    except certificates.CertificateError as error:
        yield failed(str(error), "pebble cert init")
        return
    text = f"its certificate ends in {days:.0f} days"
    yield ok(text) if days >= SOON_DAYS else warn(text, "pebble cert renew")


ROBOT: tuple[Check[Config], ...] = (
    Check("security", who_drives),
    Check("config", config_of_running),
    Check("state directory", lambda config: state_directory(config.state_dir())),
    Check("serial port", devices.serial_ports),
    Check("camera", media.cameras),
    Check("microphone", media.microphone),
    Check("loudspeaker", media.loudspeaker),
    Check("operator page", operator_page),
    Check("page's broker", page_brokers),
    Check("recorder", recorder),
    Check("broker", brokers),
)

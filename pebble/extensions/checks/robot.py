"""Checks of the robot that this machine's config describes. They change nothing; a dead broker takes seconds."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from pebble.check_result import CheckResult, State, failed, ok, warn
from pebble.config import LAUNCHER_LOCK, Config
from pebble.config.hosts import is_loopback
from pebble.config.rules import exposure
from pebble.config.rules.doors import warning_of_open
from pebble.contract.levels import LEVELS
from pebble.errors import PebbleError
from pebble.extension import items
from pebble.extensions.checks import devices
from pebble.extensions.checks.broker.account import page_account, robot_account
from pebble.extensions.checks.broker.login import beyond_loopback, broker, own_addresses
from pebble.extensions.checks.broker.login_attempt import TIMEOUT_S
from pebble.extensions.checks.check import SOON_DAYS, Check, run, some_of
from pebble.extensions.checks.machine import MACHINE
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.folder import FLEET, Fleet, FleetError, load
from pebble.extensions.fleet.roles import ProgramRole, Right, rights
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.extensions.operator.places import launcher_runs
from pebble.extensions.page.config import WebHandler, WebInterface
from pebble.extensions.page.setting import settings_of
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings

#: By the config section of each broker that the robot uses.
_BROKERS = {"local_mqtt": "local broker", "mqtt_mirror": "mirror's broker", "remote_mqtt": "remote broker"}
_WHO = "who can drive"
_NAMES_SHOWN = 12  # in one line
_DRIVERS = {
    "open": "every program that reaches its broker, which here only this machine's do",
    "login": "every account of its broker with a role that drives; which one sent a command is not checked",
    "named": "every account of its broker with a role that drives, under its own name",
}


def run_checks(config: Config | None) -> Iterator[CheckResult]:
    """Run the checks of this machine and of ``config``'s robot on it."""
    yield from (result for _, result in run(MACHINE, None))
    if config is None:
        return
    yield from (warn(warning, what="config") for warning in config.warnings)
    if config.robot.platform == "linux":
        yield from (result for _, result in run(ROBOT, config))


def who_drives(config: Config) -> Iterator[CheckResult]:
    """Report the security level, and which accounts may drive the robot at that level."""
    level = config.security.level
    if warning := warning_of_open(config):
        yield warn(warning, f"pebble fleet init FOLDER --host NAME; pebble fleet add {config.robot.id} --role robot")
        return
    yield ok(f"level {level}: it is driven by {_DRIVERS[level]}")
    folder = _fleet_folder(config) if level != "open" else None  # without accounts: only this machine reaches it
    if folder is not None:
        try:
            yield ok(_accounts(load(folder)), what=_WHO)
        except FleetError as error:
            yield warn(str(error), what=_WHO)
    if level == "named" and config.security.unnamed != "refuse":
        when = " while nobody has control" if config.security.unnamed == "free" else ""
        yield warn(
            f'also senders without a name{when}, because security.strangers is "{config.security.unnamed}"',
            "leave out security.strangers once all clients have names",
            _WHO,
        )


def _accounts(fleet: Fleet) -> str:
    """Return the accounts whose roles let them drive; those of page servers are marked."""
    names = [
        f"{name} (a page server: its people, too)" if ProgramRole.PAGE in account.roles else name
        for name, account in fleet.accounts.items()
        if Right.DRIVE in rights(account.roles, fleet.level)
    ]
    return f"{some_of(names, _NAMES_SHOWN) or 'no account'}; programs on the robot itself, too"


def _fleet_folder(config: Config) -> Path | None:
    """Return the folder of the robot's fleet, if it is here: beside its config, or beside the authority it trusts."""
    ca_cert = config.services.mqtt_bridge.remote_mqtt.tls.ca_cert
    folders = [config.folder] if ca_cert is None else [config.folder, Path(ca_cert).parent]
    return next((folder.absolute() for folder in folders if (folder / FLEET).is_file()), None)


def state_directory(path: Path) -> CheckResult:
    """Check that emergency stops can be saved; a stop that cannot would end with a power cut."""
    existing = next(folder for folder in (path, *path.parents) if os.access(folder, os.F_OK))
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return warn(
            f"{path} cannot be written: an emergency stop ends with a power cut",
            f"sudo install -d -m 700 -o $USER {path}, or set transport.state_dir",
        )
    return ok(str(path) if existing == path else f"{path} will be created")


def config_of_running(config: Config) -> Iterator[CheckResult]:
    """Check that the config file has not changed since the robot was started with it."""
    lock = config.run_dir() / LAUNCHER_LOCK  # which the launcher writes at its start
    if config.path is None or not launcher_runs(config.run_dir()):
        return
    if config.path.stat().st_mtime > lock.stat().st_mtime:
        yield warn(f"{config.path} has changed since the robot read it", "start the robot again")
    else:
        yield ok(f"{config.path}, as the robot runs")


def operator_page(config: Config) -> Iterator[CheckResult]:
    """Check that the page which the robot serves can start.

    If the page has users, only the robot's own user can check that.
    """
    if not config.section(WebHandler).enabled:
        return
    try:
        settings = settings_of(config)
        require_packages()
    except PebbleError as error:
        yield failed(str(error))  # which says what to do
        return
    if settings.login and settings.certificate is None:
        yield warn("is not encrypted: passwords can be read", "pebble cert init NAME")
    else:
        yield ok(f"port {settings.port} of {settings.host}")
    if settings.certificate is None:
        return
    try:
        days = certificates.show(settings.certificate).days_left
    except certificates.CertificateError as error:
        yield failed(str(error), "pebble cert init NAME")
        return
    text = f"its certificate ends in {days:.0f} days"
    yield ok(text) if days >= SOON_DAYS else warn(text, "pebble cert renew")


def brokers(config: Config) -> Iterator[CheckResult]:
    """Check each broker that the robot uses: its login, its rights, and on which other addresses it answers."""
    level, link = config.security.level, config.services.mqtt_bridge.link
    sections = {str(path[-1]): mqtt for path, mqtt in exposure.brokers(exposure.connections(config))}
    for section, name in _BROKERS.items():
        if (mqtt := sections.get(section)) is None:
            continue
        is_remote = section == "remote_mqtt"
        level_of_link = link.slowest if is_remote else "wide"  # only operators may be behind a slow link
        answer_s = LEVELS[level_of_link].answer_s
        settings = mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program="doctor")
        results = list(broker(name, settings, level, max(TIMEOUT_S, answer_s)))
        yield from results
        if is_remote and results[0].state is State.OK:  # the first is that of the login
            yield from robot_account(results[0].what, settings, config.base, answer_s, level)
        if is_loopback(settings.host):
            yield from beyond_loopback(name, settings, own_addresses())


def page_brokers(config: Config) -> Iterator[CheckResult]:
    """Check that the broker of an operator page accepts its login and delivers what all robots publish."""
    mqtt, level = config.section(WebInterface).mqtt, config.security.level
    if not mqtt.host:
        return
    settings = mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S)
    results = list(broker("page's broker", settings, level))
    yield from results
    if not any(result.state is State.FAILED for result in results):
        yield from page_account(results[0].what, settings, level)  # all results name the broker with its address


def extensions(config: Config) -> Iterator[CheckResult]:
    """Run the checks that extensions add, each under its extension's name."""
    for extension in config.installed:
        try:
            results = items(extension, "checks", CheckResult, config) if extension.checks else []
        except PebbleError as error:
            results = [failed(str(error), "run it again")]
        for result in results:
            yield replace(result, what=result.what or extension.name)


ROBOT: tuple[Check[Config], ...] = (
    Check("security", who_drives),
    Check("config", config_of_running),
    Check("state directory", lambda config: state_directory(config.state_dir())),
    Check("serial port", devices.serial_ports),
    Check("camera", devices.cameras),
    Check("microphone", devices.microphone),
    Check("loudspeaker", devices.loudspeaker),
    Check("operator page", operator_page),
    Check("page's broker", page_brokers),
    Check("extensions", extensions),
    Check("broker", brokers),
)

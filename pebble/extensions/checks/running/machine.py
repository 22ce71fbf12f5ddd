"""Checks of the machine of a running robot: unit, slot, clock, disk, page. They send nothing to the robot."""

import os
import shutil
import ssl
import time
from collections.abc import Mapping
from contextlib import closing
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from pathlib import Path

from pebble.check_result import CheckResult, State, failed, ok, skipped
from pebble.errors import PebbleError
from pebble.extensions.checks import machine as this_machine
from pebble.extensions.checks.check import SOON_DAYS
from pebble.extensions.checks.running.robot import RobotUnderTest
from pebble.extensions.fleet import certificates
from pebble.extensions.page.config import WebHandler
from pebble.extensions.page.setting import settings_of

UNIT = "pebble.service"
_PROPERTIES = ("LoadState", "ActiveState", "SubState", "UnitFileState", "NRestarts", "Result")
_PAGE_S = 5.0
_LEAST_FREE = 200_000_000  # bytes: logs, the audit and an update's states go on for weeks
_LEAST_SHARE = 0.02
_ANY_HOST = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - where a page that listens everywhere is asked


# -- how it was installed


def unit(robot: RobotUnderTest) -> CheckResult:
    """Check that systemd runs the robot, and starts it with the machine."""
    if robot.config.path != robot.places.config:
        return skipped(f"{UNIT} would run {robot.places.config}, which is another file")
    if shutil.which("systemctl") is None or not Path("/run/systemd/system").is_dir():
        return skipped("there is no systemd here")
    shown = this_machine.printed("systemctl", "show", UNIT, *(f"--property={name}" for name in _PROPERTIES))
    if not shown:
        return failed("systemd does not answer", "systemctl status")
    properties = {}
    for line in shown.splitlines():
        name, _, value = line.partition("=")
        properties[name] = value
    return unit_of(properties)


def unit_of(properties: Mapping[str, str]) -> CheckResult:
    """Judge the output of ``systemctl show``."""
    if properties.get("LoadState") != "loaded":
        return skipped(f"{UNIT} is not installed")
    state, sub, restarts = (properties.get(name, "?") for name in ("ActiveState", "SubState", "NRestarts"))
    if state != "active":
        result = properties.get("Result", "")
        why = "" if result in ("", "success") else f", {result}"
        fix = "sudo systemctl restart pebble; journalctl -u pebble -n 50"
        return failed(f"{UNIT} is {state} ({sub}{why})", fix)
    if (enabled := properties.get("UnitFileState", "")) not in ("enabled", "static"):
        return failed(f"{UNIT} runs, but does not start with the machine: {enabled}", "sudo systemctl enable pebble")
    return ok(f"{UNIT} runs" + (f"; restarted {restarts} times" if restarts not in ("0", "?") else ""))


def slot(robot: RobotUnderTest) -> CheckResult:
    """Check that the running slot (an installed version, see `Places.slots`) is the active one, and complete."""
    places = robot.places
    if not places.slots.is_dir() or not (places.slots / "active").is_symlink():
        return skipped("it is not installed in slots")
    active = (places.slots / "active").resolve()
    if not (active / ".complete").exists():
        return failed(f"slot {active.name} is not whole", "sudo apt install --reinstall pebble-robot")
    if not places.current_slot.is_symlink():
        return failed(f"no slot was chosen: {places.current_slot} is missing", "sudo systemctl restart pebble")
    current = places.current_slot.resolve()
    if current == active:
        return ok(f"slot {active.name} runs")
    trial = places.slot_state / "trial"
    if trial.is_file():
        return ok(f"slot {current.name} is on trial, {active.name} is the active one")
    return failed(f"slot {current.name} runs, but {active.name} is active", "sudo systemctl restart pebble")


# -- what it stands on


def clock(_robot: RobotUnderTest) -> CheckResult:
    """Warn of a clock that was never set. A robot without a network has no time server, so it is no failure."""
    result = this_machine.clock(time.time(), this_machine.synchronised())
    return result if result.state is State.FAILED else ok(result.text)


def disk(robot: RobotUnderTest) -> CheckResult:
    """Check that the disk has room for what the state directory holds: stops, the people's accounts, the audit."""
    folder = Path(os.path.normpath(robot.config.state_dir()))  # a config may name it by ../..
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    room = os.statvfs(existing)
    free, size = room.f_bavail * room.f_frsize, room.f_blocks * room.f_frsize
    text = f"{free / 1e9:.1f} of {size / 1e9:.1f} GB are free at {folder}"
    if room.f_flag & os.ST_RDONLY:
        return failed(f"{folder} is read-only: no stop survives a power cut", "sudo mount -o remount,rw /")
    if size and free < max(_LEAST_FREE, _LEAST_SHARE * size):  # some shares tell no sizes
        return failed(text, f"du -xh --max-depth=1 {folder.parent} | sort -h; journalctl --vacuum-size=50M")
    if room.f_files and not room.f_favail:
        return failed(f"{folder}: no file can be made any more", f"du -x --inodes {folder.parent} | sort -n | tail")
    return ok(text)


# -- what it serves


def page(robot: RobotUnderTest) -> CheckResult:
    """Check that the robot's page answers with the config's certificate, and how long that is still valid."""
    if not robot.config.section(WebHandler).enabled:
        return skipped("the robot serves no page: services.web_handler is off")
    try:
        settings = settings_of(robot.config)
        context, days = _trusting(settings.certificate)
    except PebbleError as error:
        return failed(str(error), "pebble doctor CONFIG")
    host = _ANY_HOST.get(settings.host, settings.host)
    shown = f"[{host}]" if ":" in host else host
    where = f"{'http' if context is None else 'https'}://{shown}:{settings.port}/"
    try:
        status = _status(host, settings.port, context)
    except ssl.SSLCertVerificationError as error:
        return failed(f"{where} shows another certificate, or one that ended: {error.verify_message}", _RENEW)
    except (OSError, HTTPException) as error:
        return failed(f"{where} does not answer: {error}", "pebble doctor CONFIG; journalctl -u pebble -n 50")
    if status >= HTTPStatus.BAD_REQUEST:
        return failed(f"{where} answers {status}", "journalctl -u pebble -n 50")
    if days is None:
        return ok(f"{where} answers, without encryption")
    if days < SOON_DAYS:
        return failed(f"{where} answers; its certificate ends in {days:.0f} days", _RENEW)
    return ok(f"{where} answers; its certificate is valid for {days:.0f} more days")


_RENEW = "pebble cert renew, then restart the robot"


def _status(host: str, port: int, context: ssl.SSLContext | None) -> int:
    plain = HTTPConnection(host, port, timeout=_PAGE_S)
    page = plain if context is None else HTTPSConnection(host, port, timeout=_PAGE_S, context=context)
    with closing(page):
        page.request("GET", "/")
        return page.getresponse().status


def _trusting(certificate: Path | None) -> tuple[ssl.SSLContext | None, float | None]:
    """Return a TLS context that trusts only this certificate, under any name, and the days until it expires."""
    if certificate is None:
        return None, None
    context = ssl.create_default_context(cafile=str(certificate))
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # this one is enough, not only that of an authority
    return context, certificates.show(certificate).days_left

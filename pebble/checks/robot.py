"""Checks of the robot on this machine, by its config. They change nothing; an unreachable broker takes seconds."""

import os
import socket
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from pebble.checks import devices, media
from pebble.checks.broker.of_config import brokers, page_brokers
from pebble.checks.check import SOON_DAYS, Check, CheckResult, State, failed, ok, run, warn
from pebble.checks.machine import MACHINE
from pebble.checks.observer import Observer
from pebble.checks.recorder import recorder
from pebble.checks.users import user_name
from pebble.checks.who import who_drives
from pebble.client.connection import Target, connected
from pebble.client.page import require_packages, settings_of
from pebble.config import LAUNCHER_LOCK, Config
from pebble.contract import STATUS
from pebble.errors import PebbleError
from pebble.fleet import certificates
from pebble.runtime.parent import launcher_runs
from pebble.transports.socket_paths import FRAMES_SOCKET, fits_socket

_ANSWER_S = 2.0
_DRIVEABLE = {"yes": State.OK, "unknown": State.WARN, "no": State.FAILED}


def run_checks(config: Config | None) -> Iterator[CheckResult]:
    """Check this machine, and ``config``'s robot on it."""
    yield from (result for _, result in run(MACHINE, None))
    if config is None:
        return
    yield from (warn(warning, what="config") for warning in config.warnings)
    if config.robot.platform == "linux":
        yield from (result for _, result in run(ROBOT, config))


# -- its folders


def run_directory(path: Path, uid: int) -> CheckResult:
    if not fits_socket(path / FRAMES_SOCKET):
        return failed(f"{path} is too long for unix sockets", "set transport.run_dir to a shorter path")
    if not path.exists():
        parent = next(folder for folder in path.parents if folder.exists())
        if os.access(parent, os.W_OK | os.X_OK):
            return ok(f"{path} will be created")
        return failed(f"{path} cannot be created", f"sudo install -d -m 700 -o {user_name(os.geteuid())} {path}")
    status = path.lstat()
    if not stat.S_ISDIR(status.st_mode):
        return failed(f"{path} is not a directory", f"rm {path}")
    if status.st_uid != uid:
        return failed(
            f"{path} belongs to {user_name(status.st_uid)}, not to you", f"sudo chown {user_name(uid)} {path}"
        )
    if status.st_mode & 0o077:
        return warn(f"{path} is open to other users", f"chmod 700 {path}")
    return ok(str(path))


def state_directory(path: Path) -> CheckResult:
    """Find a place where an emergency stop cannot be saved: it would end with a power cut."""
    existing = next(folder for folder in (path, *path.parents) if os.access(folder, os.F_OK))
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return warn(
            f"{path} cannot be written: an emergency stop ends with a power cut",
            f"sudo install -d -m 700 -o {user_name(os.geteuid())} {path}, or set transport.state_dir",
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


def leftover_sockets(run_dir: Path, answers: Callable[[Path], bool]) -> CheckResult:
    """Find sockets without a listening process; harmless, the next start removes those it uses."""
    sockets = sorted(run_dir.glob("*.sock")) if os.access(run_dir, os.R_OK) else []
    dead = [path for path in sockets if not answers(path)]
    if dead:
        return warn(f"left over from processes that are gone: {len(dead)}", "rm " + " ".join(map(str, dead)))
    return ok(f"{len(sockets)} in use" if sockets else "none: the robot is not up")


def is_listening(path: Path) -> bool:
    """True if a process listens on this socket; one that is busy, or of another user, counts."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(1.0)
        try:
            client.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


# -- what it does


def driving(config: Config) -> Iterator[CheckResult]:
    """Read on its own side whether it can be driven; nothing if it has no motors, or does not run."""
    if not config.motor_lines() or not launcher_runs(config.run_dir()):
        return
    target = Target(config=config.path, program="doctor")
    try:
        with connected(target) as (transport, names):
            robot = Observer(target, transport, names, names.base, [STATUS.filter(names.base)])
            robot.wait(lambda: robot.view.driveable, _ANSWER_S)
    except PebbleError as error:
        yield failed(f"nothing reaches the running robot: {error}")
        return
    drives = robot.view.driveable
    if drives is None:
        yield warn("the running robot does not say whether it can be driven")
    else:
        yield CheckResult(_DRIVEABLE[drives.state], drives.doubt or "commands reach the motors")


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
    if settings.certificate is not None:
        yield _page_certificate(settings.certificate)


def _page_certificate(file: Path) -> CheckResult:
    try:
        days = certificates.show(file).days_left
    except certificates.CertificateError as error:
        return failed(str(error), "pebble cert init")
    text = f"its certificate ends in {days:.0f} days"
    return ok(text) if days >= SOON_DAYS else warn(text, "pebble cert renew")


ROBOT: tuple[Check[Config], ...] = (
    Check("security", who_drives),
    Check("run directory", lambda config: run_directory(config.run_dir(), os.geteuid())),
    Check("config", config_of_running),
    Check("sockets", lambda config: leftover_sockets(config.run_dir(), is_listening)),
    Check("state directory", lambda config: state_directory(config.state_dir())),
    Check("serial port", devices.serial_ports),
    Check("driving", driving),
    Check("camera", media.cameras),
    Check("microphone", media.microphone),
    Check("codecs", media.codecs),
    Check("sockets of the original", media.sockets_of_the_original),
    Check("loudspeaker", media.loudspeaker),
    Check("operator page", operator_page),
    Check("page's broker", page_brokers),
    Check("recorder", recorder),
    Check("broker", brokers),
)

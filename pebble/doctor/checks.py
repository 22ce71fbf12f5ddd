"""Checks of a machine and of the robot on it. They change nothing, and return findings."""

import grp
import os
import pwd
import resource
import shutil
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import metadata
from pathlib import Path

from pebble.check_result import CheckResult, State
from pebble.client.page.from_config import settings_of
from pebble.client.page.packages import require_packages
from pebble.config import Config, Mqtt
from pebble.config.web import is_loopback
from pebble.contract.levels import LEVELS
from pebble.doctor import device_names, fail, ok, warn
from pebble.doctor.broker.login import SOON_S, broker
from pebble.doctor.broker_probe import TIMEOUT_S, probe
from pebble.doctor.driving import driving
from pebble.doctor.loudspeaker import loudspeaker
from pebble.doctor.media import media
from pebble.doctor.publishing import of_page, publishing
from pebble.doctor.reachable import beyond_loopback, own_addresses
from pebble.doctor.recordings import recorder
from pebble.doctor.who import who_drives
from pebble.errors import PebbleError
from pebble.fleet import certificates
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings
from pebble.transports.socket_paths import FRAMES_SOCKET, fits_socket

_ENOUGH_LOCKED = 64 * 1024 * 1024  # a camera's pool of frames at 1080p
_BUILT = 1735689600  # 2025: a clock before this has not been set
_TIMEDATECTL_S = 3.0


def run_checks(config: Config | None) -> Iterator[CheckResult]:
    """Check this machine, and ``config``'s robot on it. Takes seconds if a broker is unreachable."""
    yield python_version(sys.version_info[:3])
    for package in ("eclipse-zenoh", "paho-mqtt"):
        yield installed(package)
    yield memory_lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], root=os.geteuid() == 0)
    yield clock(time.time(), synchronised())
    yield leftover_segments(Path("/dev/shm"), Path("/proc"))  # noqa: S108 - where Zenoh puts them
    if config is None:
        return
    yield from (warn("config", warning) for warning in config.warnings)
    if config.robot.platform == "linux":
        yield from _robot(config)


def _robot(config: Config) -> Iterator[CheckResult]:
    run_dir = config.run_dir()
    yield from who_drives(config)
    yield run_directory(run_dir, os.geteuid())
    yield leftover_sockets(run_dir, is_listening)
    yield state_directory(config.state_dir())
    for name, line in config.serial_instances().items():
        yield serial_port(Path(str(line.serial.port)), name)
    if (driveable := driving(config)) is not None:
        yield driveable
    yield from media(config, Path("/dev"))
    yield from loudspeaker(config)
    yield from operator_page(config)
    yield from page_brokers(config)
    yield from recorder(config)
    level = config.security.level
    for name, mqtt in _brokers(config):
        bridge = config.services.mqtt_bridge
        answer_s = LEVELS[bridge.link.slowest if mqtt is bridge.remote_mqtt else "wide"].answer_s
        for settings in mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S, program="doctor").each():
            found = list(broker(name, settings, partial(probe, timeout_s=max(TIMEOUT_S, answer_s)), level=level))
            yield from found
            if mqtt is bridge.remote_mqtt and found[0].state is State.OK:
                yield from publishing(found[0].what, settings, config.base, answer_s, level)
            if is_loopback(settings.host):
                yield from beyond_loopback(name, settings, own_addresses())


def operator_page(config: Config) -> Iterator[CheckResult]:
    """Whether the page that the robot itself serves can start; whether it has users, only its own user can read."""
    if not config.services.web_handler.enabled:
        return
    try:
        settings = settings_of(config)
        require_packages()
    except PebbleError as error:
        yield fail("operator page", str(error))  # which says what to do
        return
    if settings.login and settings.certificate is None:
        yield warn("operator page", "is not encrypted: passwords can be read", "pebble cert init")
    else:
        yield ok("operator page", f"port {settings.port} of {settings.host}")
    if settings.certificate is not None:
        yield _page_certificate(settings.certificate, time.time())


def page_brokers(config: Config) -> Iterator[CheckResult]:
    """Whether each broker of an operator page that has its own lets it in, and delivers what all robots send."""
    mqtt, level = config.web_interface.mqtt, config.security.level
    for settings in mqtt_settings(mqtt, reconnect_max_s=REMOTE_RECONNECT_S).each() if mqtt.host else ():
        found = list(broker("page's broker", settings, level=level))
        yield from found
        if not any(one.state is State.FAILED for one in found):
            yield from of_page(found[0].what, settings, level)


def _page_certificate(file: Path, now: float) -> CheckResult:
    try:
        left_s = certificates.show(file).until.timestamp() - now
    except certificates.CertificateError as error:
        return fail("operator page", str(error), "pebble cert init")
    text = f"its certificate ends in {left_s / 86400:.0f} days"
    return ok("operator page", text) if left_s >= SOON_S else warn("operator page", text, "pebble cert renew")


def _brokers(config: Config) -> Iterator[tuple[str, Mqtt]]:
    bridge, transport = config.services.mqtt_bridge, config.transport
    if transport.kind == "mqtt":
        yield "local broker", config.local_mqtt
    if transport.mqtt_mirror is not None:
        yield "mirror's broker", transport.mqtt_mirror
    if bridge.enabled and (bridge.remote is None or bridge.remote.kind == "mqtt"):
        yield "remote broker", bridge.remote_mqtt


# -- this machine


def python_version(version: tuple[int, ...]) -> CheckResult:
    text = ".".join(map(str, version))
    if version < (3, 11):
        return fail("python", f"{text} is too old, 3.11 is needed", "sudo apt install python3.11")
    return ok("python", text)


def installed(package: str) -> CheckResult:
    try:
        return ok(package, metadata.version(package))
    except metadata.PackageNotFoundError:
        return fail(package, "is not installed", f"{sys.executable} -m pip install {package}")


def memory_lock(limit: int, *, root: bool) -> CheckResult:
    """``limit`` in bytes, or RLIM_INFINITY. A reader that cannot lock a shared segment loses every frame silently."""
    if limit == resource.RLIM_INFINITY or limit >= _ENOUGH_LOCKED or root:
        return ok("memory lock", "no limit that matters")
    return warn(
        "memory lock",
        f"limited to {limit // 1024} kB: too little for shared camera frames",
        "LimitMEMLOCK=infinity in the systemd unit, or `ulimit -l unlimited` in a root shell",
    )


def clock(now: float, synchronised: bool | None) -> CheckResult:
    """``now`` in epoch seconds; ``synchronised`` None if unknown."""
    if now < _BUILT:
        year = time.gmtime(now).tm_year
        return fail("clock", f"is set to {year}: stamps will be wrong", "sudo timedatectl set-ntp true")
    if synchronised is False:
        return warn("clock", "is not synchronised: latencies will be wrong", "sudo timedatectl set-ntp true")
    return ok("clock", "synchronised" if synchronised else "plausible; not known to be synchronised")


def synchronised() -> bool | None:
    """Is the clock synchronised by NTP, according to systemd? None without systemd."""
    if shutil.which("timedatectl") is None:
        return None
    try:
        done = subprocess.run(
            ["timedatectl", "show", "--property=NTPSynchronized", "--value"],
            capture_output=True,
            text=True,
            timeout=_TIMEDATECTL_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return {"yes": True, "no": False}.get(done.stdout.strip())


def leftover_segments(shm: Path, proc: Path) -> CheckResult:
    """Finds Zenoh's shared memory of this user that no process has mapped."""
    mine = {path for path in shm.glob("*.zenoh") if _owner(path) == os.geteuid()}
    if not mine:
        return ok("shared memory", "no segments left over")
    unused = sorted(mine - _mapped(proc, mine))
    if not unused:
        return ok("shared memory", f"segments in use: {len(mine)}")
    megabytes = sum(path.stat().st_size for path in unused if path.exists()) / 1e6
    return warn(
        "shared memory",
        f"left over from processes that are gone: {len(unused)} ({megabytes:.1f} MB)",
        "rm " + " ".join(map(str, unused)),
    )


def _mapped(proc: Path, paths: set[Path]) -> set[Path]:
    found: set[Path] = set()
    for maps in proc.glob("[0-9]*/maps"):
        try:
            text = maps.read_text(errors="replace", encoding="utf-8")
        except OSError:  # ended meanwhile, or of another user
            continue
        found |= {path for path in paths if str(path) in text}
    return found


def _owner(path: Path) -> int | None:
    try:
        return path.lstat().st_uid
    except OSError:
        return None


# -- one robot on it


def run_directory(path: Path, uid: int) -> CheckResult:
    what = "run directory"
    if not fits_socket(path / FRAMES_SOCKET):
        return fail(what, f"{path} is too long for unix sockets", "set transport.run_dir to a shorter path")
    if not path.exists():
        return _missing_run_directory(path)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return fail(what, f"{path} is not a directory", f"rm {path}")
    if found.st_uid != uid:
        return fail(what, f"{path} belongs to {_user(found.st_uid)}, not to you", f"sudo chown {_user(uid)} {path}")
    if found.st_mode & 0o077:
        return warn(what, f"{path} is open to other users", f"chmod 700 {path}")
    return ok(what, str(path))


def _missing_run_directory(path: Path) -> CheckResult:
    parent = next(folder for folder in path.parents if folder.exists())
    if not os.access(parent, os.W_OK | os.X_OK):
        owner = _user(os.geteuid())
        return fail("run directory", f"{path} cannot be created", f"sudo install -d -m 700 -o {owner} {path}")
    return ok("run directory", f"{path} will be created")


def state_directory(path: Path) -> CheckResult:
    """Finds a place where an emergency stop cannot be saved: it would end with a power cut."""
    what = "state directory"
    existing = next(folder for folder in (path, *path.parents) if os.access(folder, os.F_OK))
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        return warn(
            what,
            f"{path} cannot be written: an emergency stop ends with a power cut",
            f"sudo install -d -m 700 -o {_user(os.geteuid())} {path}, or set transport.state_dir",
        )
    return ok(what, str(path) if existing == path else f"{path} will be created")


def leftover_sockets(run_dir: Path, answers: Callable[[Path], bool]) -> CheckResult:
    """Finds sockets without a listening process; harmless, the next start removes those it uses."""
    sockets = sorted(run_dir.glob("*.sock")) if os.access(run_dir, os.R_OK) else []
    dead = [path for path in sockets if not answers(path)]
    if dead:
        return warn("sockets", f"left over from processes that are gone: {len(dead)}", "rm " + " ".join(map(str, dead)))
    return ok("sockets", f"{len(sockets)} in use" if sockets else "none: the robot is not up")


def is_listening(path: Path) -> bool:
    """Whether a process listens on this socket; one that is busy, or of another user, counts."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


def serial_port(path: Path, name: str = "", names: Path = Path("/dev/serial")) -> CheckResult:
    """``name``: of the instance in the config; ``names``: the folder with by-id/."""
    what, key = f"serial port {path}", _port_key(name)
    try:
        found = path.stat()
    except OSError:
        return device_names.missing(what, "does not exist: is the MCU plugged in?", key, names)
    if not stat.S_ISCHR(found.st_mode):
        return fail(what, "is not a device", f"correct {key}")
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(found.st_gid)
        return fail(
            what, f"may only be used by {group}", f"sudo usermod -aG {group} {_user(os.geteuid())}, then log in again"
        )
    return device_names.usable(what, path, "readable and writable", key, names)


def _port_key(instance: str) -> str:
    within = f"instances.{instance}." if instance else ""
    return f"services.serial_mcu_bridge.{within}serial.port"


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _group(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)

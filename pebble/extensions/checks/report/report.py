"""The report as a zip file: configs, status, logs and facts of the machine, without passwords or keys."""

from __future__ import annotations

import io
import json
import os
import platform
import sys
import time
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from pebble.config import Config, load
from pebble.config.config import resolved
from pebble.config.masking import masked
from pebble.config.problems import Notes
from pebble.config.raw import decode, plain, read_text
from pebble.config.secret_text import HIDDEN, without_secrets
from pebble.contract import OUTGOING
from pebble.errors import PebbleError
from pebble.extensions.checks.machine import output_of
from pebble.extensions.checks.report.secrets_here import Secrets, secrets_of
from pebble.extensions.checks.robot import run_checks
from pebble.extensions.checks.running.robot import user_of
from pebble.extensions.operator.places import Places
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner
from pebble.version import __version__

_JOURNAL_LINES = 2000
_PROGRAM_S = 20.0
_LONGEST_PART = 8 << 20  # bytes
_STATES_S = 1.0  # until all have come
_VARIABLES = ("PATH", "PYTHONPATH", "LANG", "LC_ALL", "TMPDIR", "XDG_RUNTIME_DIR")  # that say where things are
_UNITS = ("etc/systemd/system", "usr/lib/systemd/system", "lib/systemd/system", "usr/local/lib/systemd/system")


@dataclass(frozen=True)
class Here:
    """The robot to report on: the one installed below ``places``, or that of another config."""

    places: Places
    file: Path
    config: Config | None = None  # None: it has mistakes, or is not there
    problem: str = ""


Part = Callable[[Here], str]


@dataclass
class Report:
    """The written report. ``missing``: parts that are not in it, and why; ``unread``: files not searched."""

    parts: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()

    def packed(self) -> bytes:
        output = io.BytesIO()
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, text in self.parts.items():
                packed.writestr(name, text.encode(errors="backslashreplace"))
        return output.getvalue()


def make(places: Places, file: Path | None = None) -> Report:
    """Collect all parts, with this machine's secrets masked. A part that fails is named in the index."""
    here = _here(places, file or places.config)
    secrets = secrets_of(places, here.config, [here.file])
    report = Report(unread=secrets.unread)
    # Stars replace the secrets that are known here, in any text, and words that look like passwords or tokens.
    for name, part in PARTS.items():
        try:
            report.parts[name] = secrets.hidden(without_secrets(part(here)))[:_LONGEST_PART]
        except Exception as error:  # noqa: BLE001 - what is broken is why there is a report: the rest is in it
            kind = "" if isinstance(error, PebbleError) else f"{type(error).__name__}: "
            report.missing[name] = secrets.hidden(without_secrets(kind + " ".join(str(error).split())))
    report.parts = {"index.txt": secrets.hidden(_index(report, secrets)), **report.parts}
    return report


def _here(places: Places, file: Path) -> Here:
    """Read the config, with the state directory that systemd names for an installed robot."""
    env = {"STATE_DIRECTORY": str(places.state)} if file == places.config and places.state.exists() else {}
    try:
        return Here(places, file, load(file, {**os.environ, **env}))
    except PebbleError as error:
        return Here(places, file, None, str(error))


def _index(report: Report, secrets: Secrets) -> str:
    lines = [f"Pebble {__version__}, {time.strftime('%Y-%m-%d %H:%M:%S %z')}", ""]
    lines += [f"{name}: {len(text):,} characters" for name, text in report.parts.items()]
    lines += [f"{name}: MISSING: {why}" for name, why in report.missing.items()]
    lines += ["", f"{len(secrets.known)} passwords and keys of this machine are hidden in it"]
    lines += [f"too short to be hidden: one in {where}" for where in secrets.short]
    lines += [f"could not be read, so what is in it is not hidden: {file}" for file in secrets.unread]
    return "\n".join(lines) + "\n"


# -- the parts


def _config(here: Here) -> str:
    """Return the config file and the config with its defaults, with secrets masked.

    Of the file's texts only those are shown that the config has: any other may be a secret at an unknown key.
    """
    written = masked(plain(decode(read_text(here.file), here.file.name), Notes()))
    complete = {} if here.config is None else {"resolved": resolved(here.config)}
    problems = {"problems": here.problem.splitlines()} if here.config is None else {}
    config = {"file": str(here.file), "written": _shown(written, {*_texts(complete)}), **problems, **complete}
    return json.dumps(config, indent=1, ensure_ascii=False)


def _texts(value: Any) -> Iterator[str]:
    """Yield all texts in plain data, but no keys."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)


def _shown(value: Any, known: Collection[str]) -> Any:
    """Return plain data with stars in place of texts that are not ``known``."""
    if isinstance(value, dict):
        return {key: _shown(item, known) for key, item in value.items()}
    if isinstance(value, list):
        return [_shown(item, known) for item in value]
    return HIDDEN if isinstance(value, str) and value not in known else value


def _doctor(here: Here) -> str:
    results = run_checks(here.config)
    lines = [f"{result.state:<7}  {result.what}: {result.text}  {result.fix}\n" for result in results]
    return "".join(lines) + here.problem


def _status(here: Here) -> str:
    """Return the messages that the robot publishes and retains on its own transport.

    They are read as the robot's user, because root may not.
    """
    if here.config is None:
        raise PebbleError("the config cannot be read")
    user, file = user_of(here.config.run_dir()), str(here.file.absolute())
    options: dict[str, Any] = {}
    if user is not None:  # a user sees the variables of their processes: this one gets only these
        env = {name: os.environ[name] for name in (*_VARIABLES, *here.config.password_variables) if name in os.environ}
        options = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": [], "env": env}
    topics = f"{here.config.base}/{OUTGOING}/#"
    echo = ("-Pm", "pebble.cli", "topic", "echo", topics, "--seconds", str(_STATES_S), "--config", file)
    return output_of(sys.executable, *echo, seconds=_PROGRAM_S, **options)


def _journal(here: Here) -> str:
    root = [] if here.places.root == Path("/") else [f"--root={here.places.root}"]
    units = [word for name in ("pebble*", "mosquitto*") for word in ("--unit", name)]
    options = (f"--lines={_JOURNAL_LINES}", "--no-pager", "--output=short-iso")
    return output_of("journalctl", *root, *units, *options, seconds=_PROGRAM_S)


def _versions(here: Here) -> str:
    lines = [f"pebble {__version__}", f"python {sys.version}", f"{sys.executable}", " ".join(platform.uname())]
    release = here.places.root / "etc/os-release"
    if release.is_file():
        lines += release.read_text(encoding="utf-8", errors="replace").splitlines()
    installed = {package.name: package.version for package in metadata.distributions()}
    return "\n".join([*lines, *(f"{name} {version}" for name, version in sorted(installed.items()))]) + "\n"


def _files(*patterns: str) -> Part:
    """Return a part with all files that match, below the root."""

    def part(here: Here) -> str:
        files = sorted({file for pattern in patterns for file in here.places.root.glob(pattern)})
        if not files:
            raise PebbleError("there are no such files")
        return "\n".join(map(_described, files)) + "\n"

    return part


def _described(path: Path) -> str:
    if path.is_symlink():
        return f"# {path} -> {path.readlink()}"
    if path.is_file():
        with as_owner(path.parent):
            return f"# {path}\n{read_plain(path).decode(errors='replace').strip()}"
    return f"# {path}/"


def _programs(*commands: tuple[str, ...]) -> Part:
    """Return a part with the output of these commands."""
    return lambda _here: "".join(output_of(*command, seconds=_PROGRAM_S) for command in commands)


#: In the order in which a reader wants them.
PARTS: dict[str, Part] = {
    "config.json": _config,
    "doctor.txt": _doctor,
    "status.txt": _status,
    "journal.txt": _journal,
    "units.txt": _files(
        *(f"{folder}/pebble*{inner}" for folder in _UNITS for inner in ("", "/*")), "etc/polkit-1/rules.d/*pebble*"
    ),
    "slots.txt": _files("opt/pebble/*", "opt/pebble/*/.complete", "run/pebble-slot/*", "var/lib/pebble-update/*"),
    "versions.txt": _versions,
    "lsusb.txt": _programs(("lsusb",)),
    "devices.txt": _files("dev/*/by-id/*"),
    "disk.txt": _programs(("df", "-h", "-x", "tmpfs"), ("free", "-h"), ("uptime",)),
}

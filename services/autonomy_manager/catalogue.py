"""The catalogue of scripts: folders with an entry point, described by the config and by the scripts themselves."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec.structs import asdict, replace

import pebble
from pebble.config import Config
from pebble.config.home import in_home
from pebble.contract.identity import meant
from pebble.errors import PebbleError
from pebble.extensions.operator.client.forms import MAX_SETTINGS, Setting, form
from pebble.extensions.scripts.config import AutonomyManager
from pebble.extensions.scripts.config import Script as ScriptSection
from pebble.runtime.as_owner import require_own
from pebble.services.autonomy_manager.describe import (
    MANIFEST,
    BrokenScriptError,
    DescribeError,
    Description,
    ask,
    is_ours,
    read_manifest,
    stamp,
)
from pebble.services.autonomy_manager.environment import environment, local_login
from pebble.services.autonomy_manager.interpreter import interpreter
from pebble.services.autonomy_manager.script import Dependency, Script

MAX_SCRIPTS = 256  # that are listed
_LONGEST_NAME = 100
_LONGEST_FILES = 256 * 1024  # bytes of all forms together
_TELL_S = 1.0  # between two lists while scripts are asked
_RETRY_S = 60.0  # after a failure: it may have been a busy machine's
_OWN_SCRIPTS = Path(pebble.__file__).parent / "extensions" / "scripts" / "shipped"

log = logging.getLogger(__name__)


def roots(config: Config, own: Path = _OWN_SCRIPTS) -> tuple[Path, ...]:
    """Return the folders to search for scripts; of scripts with one name the first counts.

    An absolute ``autonomy_root`` is the only folder. A relative one starts at the config's folder or, as in the
    original program, two folders above a config in ``control/configs``. Pebble's own scripts come last.
    """
    configured = in_home(config.section(AutonomyManager).autonomy_root)
    if configured.is_absolute():
        return (configured,)
    beside = [config.folder / configured]
    if config.folder.parts[-2:] == ("control", "configs"):
        beside.append(config.folder.parent.parent / configured)
    return (*beside, own)


class _Answer(NamedTuple):
    """A script's description, or why it has no settings or cannot be started."""

    description: Description
    ours: bool = False
    problem: str = ""
    broken: bool = False  # because of ``problem`` it cannot be started; else it only has no settings
    asked: bool = True  # False: what it says itself is not known yet
    drives: bool = True  # False: it says itself that it only measures, and never drives


class Catalogue:
    """The scripts in the folders. Used by one thread, because asking a script takes up to 20 s.

    Our scripts are those that use ``pebble.script``: they can be asked, by running them with ``--describe``.
    """

    def __init__(self, config: Config, *, asks: bool = True, clock: Callable[[], float] = time.monotonic) -> None:
        """Store the folders. ``asks`` False: list our scripts without running them for their settings."""
        self._config, self._section, self._asks = config, config.section(AutonomyManager), asks
        self._roots, self._login = roots(config), local_login(config)
        self._clock = clock
        #: By name: the version of its files, what they say, and until when that counts.
        self._answers: dict[str, tuple[object, _Answer, float]] = {}
        self._complained: set[str] = set()  # names with a warning in the log

    def scan(self, tell: Callable[[dict[str, Script]], object]) -> None:
        """Call ``tell`` with all scripts: at once, and again when scripts that had to be run have answered."""
        folders = dict(self._folders())
        scripts = self._scripts(folders, asks=False)
        if self._asks:
            tell(dict(scripts))
            told_at = self._clock()
            for name, places in folders.items():
                scripts.update(self._scripts({name: places}, asks=True))
                if self._clock() - told_at >= _TELL_S:
                    tell(dict(scripts))
                    told_at = self._clock()
        self._answers = {name: answer for name, answer in self._answers.items() if name in folders}
        tell(scripts)

    def _scripts(self, folders: Mapping[str, list[Path]], *, asks: bool) -> dict[str, Script]:
        """Return the scripts by their names. ``asks`` False: run none of them now, see :meth:`_describe`."""
        scripts = {}
        for name, places in folders.items():
            candidates = (self._script(name, folder, asks=asks) for folder in places)
            script = next(filter(None, candidates), None)  # of the first folder that has one
            if script is not None:
                scripts[name] = script
        return scripts

    def _folders(self) -> Iterator[tuple[str, list[Path]]]:
        """Yield each name of a script, with the folders of this name in the order in which they count."""
        folders: dict[str, list[Path]] = {}
        for root in self._roots:
            for folder in _inside(root):
                folders.setdefault(folder.name, []).append(folder)
        usable = sorted(filter(self._usable, folders), key=lambda name: (name.lower(), name))
        if len(usable) > MAX_SCRIPTS:
            self._complain("", "%d scripts are too many: only the first %d are offered", len(usable), MAX_SCRIPTS)
        for name in usable[:MAX_SCRIPTS]:
            yield name, folders[name]

    def _usable(self, name: str) -> bool:
        if name.startswith((".", "_")):
            return False
        if len(name) > _LONGEST_NAME or not name.isprintable() or "]" in name:  # which ends the tag of a log line
            self._complain(name[:_LONGEST_NAME], "%r is not offered: rename its folder", name)
            return False
        try:
            return self._section_of(name).enabled
        except PebbleError as error:
            self._complain(name, "%s is not offered: in services.autonomy_manager.scripts %s", name, error)
            return False

    def _section_of(self, name: str) -> ScriptSection:
        sections = self._section.scripts
        return sections.get(meant(sections, name), ScriptSection())

    def _script(self, name: str, folder: Path, *, asks: bool) -> Script | None:
        """Return the script in a folder; None if it has neither an entry point nor a command of its own."""
        section = self._section_of(name)
        entry = folder / section.entrypoint
        answer = self._answer(name, folder, entry, section, asks=asks)
        described = answer.description
        if not described.command and not entry.is_file():
            return None
        return Script(
            file=name,
            label=(section.display_name or described.label or name)[:_LONGEST_NAME],
            command=self._command(folder, entry, section, described, ours=answer.ours),
            folder=section.cwd or folder,
            settings=self._settings(name, section, described, ours=answer.ours),
            summary=described.summary,
            main=tuple(described.main),
            dependencies=_dependencies(name, section, described),
            environment={**self._login, **section.env},
            ours=answer.ours,
            broken=answer.problem if answer.broken else "",
            asked=answer.asked,
            own_program=bool(described.command),
            drives=answer.drives,
        )

    def _answer(self, name: str, folder: Path, entry: Path, section: ScriptSection, *, asks: bool) -> _Answer:
        """Return a script's description. It is kept until the script's files change; a failure is kept for a minute."""
        version = entry, stamp(entry), stamp(folder / MANIFEST)
        version_before, before, until = self._answers.get(name, (None, _Answer(Description()), 0.0))
        is_current = version_before == version and self._clock() < until
        if is_current or (version_before is not None and not asks):  # not to be asked now: its last answer counts
            return before
        answer = self._describe(folder, entry, section, asks=asks)
        if not answer.asked:  # it is asked later: nothing to keep
            return answer
        if answer.problem and answer.problem != before.problem:
            what = "cannot be started" if answer.broken else "is offered without settings"
            log.warning("%s %s: %s", name, what, answer.problem)
        self._answers[name] = version, answer, self._clock() + _RETRY_S if answer.problem else float("inf")
        return answer

    def _describe(self, folder: Path, entry: Path, section: ScriptSection, *, asks: bool) -> _Answer:
        """Return a script's description: by its files, and if it is one of ours, by its own answer.

        ``asks`` False: do not run it now; the description says if it has still to be asked.
        """
        described, problem = Description(), ""
        try:
            if folder.parent != _OWN_SCRIPTS:
                require_own(entry, does="runs nothing of it")
        except PebbleError as error:
            return _Answer(described, problem=str(error), broken=True)
        try:
            described = read_manifest(folder / MANIFEST) or described
        except DescribeError as error:
            problem = str(error)
        if described.command:
            return _Answer(described)
        try:
            ours = is_ours(entry)
        except BrokenScriptError as error:
            if section.python is not None:  # it may be valid for that Python
                return _Answer(described, problem=problem)
            return _Answer(described, problem=str(error), broken=True)
        if not ours or not self._asks:  # only ours are asked, and only if this catalogue asks
            return _Answer(described, ours, problem)
        if not asks:  # it is ours, and is asked later
            return _Answer(described, ours, problem, asked=False)
        command = self._command(folder, entry, section, described, ours=True)
        try:
            answer = ask(command, folder, environment(section.env))
            return _Answer(_merged(described, answer), ours, problem, drives=answer.drives)
        except DescribeError as error:
            is_broken = isinstance(error, BrokenScriptError)
            return _Answer(described, ours, problem=str(error), broken=is_broken)

    def _command(
        self, folder: Path, entry: Path, section: ScriptSection, described: Description, *, ours: bool
    ) -> tuple[str, ...]:
        """Return the script's command line without options."""
        python = section.python
        if python is not None and "/" in python:
            python = str(self._config.folder / in_home(python))
        if described.command:
            program, *arguments = described.command
            if program in ("python", "python3"):
                program = interpreter(python, ours=ours)
            return (str(folder / program) if "/" in program else program, *arguments)
        if python is None and entry.suffix != ".py" and os.access(entry, os.X_OK):
            return (str(entry),)
        return (interpreter(python, ours=ours), str(entry))

    def _settings(
        self, name: str, section: ScriptSection, described: Description, *, ours: bool
    ) -> tuple[Setting, ...]:
        """Return the config's settings, and then those that only the script gives.

        Of a setting in both, the config's counts. But our scripts read their options themselves: so their settings are
        written on the command line in the script's form, and a setting of the config that the script lacks is left out.
        """
        configured = [Setting(**asdict(argument)) for argument in section.args]
        options = {setting.key: setting for setting in described.configs}
        if ours and options:
            unknown = [setting.key for setting in configured if setting.key not in options]
            if unknown:
                self._complain(name, "%s has no setting %s: ignored", name, ", ".join(unknown))
            with_options = [(setting, options[setting.key]) for setting in configured if setting.key in options]
            configured = [
                replace(setting, arg=option.arg, arg_false=option.arg_false, mode=option.mode)
                for setting, option in with_options
            ]
        merged = {setting.key: setting for setting in configured}
        settings = (*merged.values(), *(option for key, option in options.items() if key not in merged))
        if len(settings) > MAX_SETTINGS:
            self._complain(name, "%s is offered without settings: %d are too many", name, len(settings))
            return ()
        return settings

    def _complain(self, name: str, text: str, *values: object) -> None:
        """Log a warning, once for each script."""
        if name not in self._complained and len(self._complained) < MAX_SCRIPTS:
            self._complained.add(name)
            log.warning(text, *values)


def files(scripts: Iterable[Script]) -> list[dict[str, object]]:
    """Return the ``files`` of `autonomy-files`. If a form would make it too long, it and all later ones are omitted."""
    entries: list[dict[str, object]] = []
    room = _LONGEST_FILES
    for script in scripts:
        configs = form(script.settings)
        room -= len(msgspec.json.encode(configs))
        configs = configs if room >= 0 else []
        entry = {"file": script.file, "label": script.label, "configs": configs}
        entries.append(entry | _optional_fields(script, configs))
    return entries


def _optional_fields(script: Script, configs: Iterable[Mapping[str, object]]) -> dict[str, object]:
    """Return an entry's optional fields: ``summary``, ``main`` (settings to show first), ``asked`` (only if False)."""
    keys = {setting["key"] for setting in configs}
    first = {"summary": script.summary, "main": [key for key in script.main if key in keys]}
    unasked = {} if script.asked else {"asked": False}
    return unasked | {name: value for name, value in first.items() if value}


def _inside(root: Path) -> list[Path]:
    try:
        return [folder for folder in root.iterdir() if folder.is_dir()]
    except OSError:  # most often there is none
        return []


def _merged(manifest: Description, answer: Description) -> Description:
    """Return a manifest's description, with its missing fields taken from the script's own answer.

    The manifest has no ``command``, else the script is not asked. ``drives`` the caller takes from the answer itself.
    """
    keys = {setting.key for setting in manifest.configs}
    added = [setting for setting in answer.configs if setting.key not in keys]
    return Description(
        label=manifest.label or answer.label,
        summary=manifest.summary or answer.summary,
        main=manifest.main or answer.main,
        configs=[*manifest.configs, *added][:MAX_SETTINGS],
        dependencies=manifest.dependencies or answer.dependencies,
    )


def _dependencies(name: str, section: ScriptSection, described: Description) -> tuple[Dependency, ...]:
    """Return the dependencies in the config, or else the script's; each script once, and never itself."""
    declared = described.dependencies
    if section.dependencies:
        enabled = [dependency for dependency in section.dependencies if dependency.enabled]
        declared = [Dependency(dependency.file, dict(dependency.config)) for dependency in enabled]
    by_file = {dependency.file: dependency for dependency in declared if dependency.file != name}
    return tuple(by_file.values())

"""Which scripts there are: folders with an entry point, what the config lists, what they publish about themselves."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import msgspec
from msgspec.structs import asdict, replace

import pebble
from pebble.config import Config
from pebble.config.autonomy import Script as ScriptSection
from pebble.config.home import in_home
from pebble.contract.forms import MAX_SETTINGS, Setting, form
from pebble.contract.identity import meant
from pebble.services.autonomy_manager.describe import (
    MANIFEST,
    BrokenScriptError,
    Description,
    Descriptions,
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
_LONGEST_FORM = 16 * 1024  # bytes
_LONGEST_FILES = 256 * 1024  # bytes of all forms together
_MAX_DEPENDENCIES = 8  # of one script
_OWN_SCRIPTS = Path(pebble.__file__).parent / "scripts"

log = logging.getLogger(__name__)


def roots(config: Config, own: Path = _OWN_SCRIPTS) -> tuple[Path, ...]:
    """The folders of scripts; of two scripts with one name, that in the first folder counts.

    An absolute path is the only folder; a relative one is searched beside the config, and then Pebble's own.
    The original starts relative paths at its repository, two folders above its configs.
    """
    given = in_home(config.services.autonomy_manager.autonomy_root)
    if given.is_absolute():
        return (given,)
    beside = [config.folder / given]
    if config.folder.parts[-2:] == ("control", "configs"):
        beside.append(config.folder.parent.parent / given)
    return (*beside, own)


class Catalogue:
    """Scans the folders. For one thread, because to ask a script takes up to 20 s."""

    def __init__(self, config: Config, *, asks: bool = True) -> None:
        """``asks`` is False for a list of scripts without the settings of ours."""
        self._config, self._section, self._asks = config, config.services.autonomy_manager, asks
        self._roots, self._login = roots(config), local_login(config)
        self._manifests, self._answers = Descriptions(), Descriptions()
        self._ours: dict[str, tuple[object, bool, str]] = {}  # by name: version, whether it is ours, what is wrong
        self._scanned = False
        self._complained: set[str] = set()  # names with a warning in the log

    def scan(self, found: Callable[[dict[str, Script]], object]) -> None:
        """Call ``found`` with all scripts; the first time also with those so far, before one is asked."""
        folders = dict(self._folders())
        scripts: dict[str, Script] = {}
        for name, places in folders.items():
            before_asking = partial(self._before_asking, scripts, found)
            for folder in places:
                if (script := self._script(name, folder, before_asking)) is not None:
                    scripts[name] = script
                    break
        for descriptions in (self._manifests, self._answers):
            descriptions.retain_only(set(folders))
        self._ours = {name: answer for name, answer in self._ours.items() if name in folders}
        self._scanned = True
        found(scripts)

    def _before_asking(self, scripts: dict[str, Script], found: Callable[[dict[str, Script]], object]) -> None:
        if not self._scanned:
            found(dict(scripts))

    def _folders(self) -> Iterator[tuple[str, list[Path]]]:
        names: dict[str, list[Path]] = {}
        for root in self._roots:
            for folder in _inside(root):
                names.setdefault(folder.name, []).append(folder)
        usable = sorted(filter(self._usable, names), key=lambda name: (name.lower(), name))
        if len(usable) > MAX_SCRIPTS:
            self._complain("", "%d scripts are too many: only the first %d are offered", len(usable), MAX_SCRIPTS)
        for name in usable[:MAX_SCRIPTS]:
            yield name, names[name]

    def _usable(self, name: str) -> bool:
        if name.startswith((".", "_")):
            return False
        if len(name) > _LONGEST_NAME or not name.isprintable() or "]" in name:
            self._complain(name[:_LONGEST_NAME], "%r is not offered: rename its folder", name)
            return False
        return self._section_of(name).enabled

    def _section_of(self, name: str) -> ScriptSection:
        sections = self._section.scripts
        return sections.get(meant(sections, name), ScriptSection())

    def _script(self, name: str, folder: Path, before_asking: Callable[[], object]) -> Script | None:
        section = self._section_of(name)
        entry, manifest = folder / section.entrypoint, folder / MANIFEST
        described = self._manifests.get(name, [manifest], lambda: _manifest(manifest)) or Description()
        if not described.command and not entry.is_file():
            return None
        ours, broken = (False, "") if described.command else self._is_ours(name, entry, section)
        command = self._command(folder, entry, section, described, ours=ours)
        if ours and self._asks:

            def question() -> Description:
                before_asking()
                return ask(command, folder, environment(section.env))

            answer = self._answers.get(name, [entry], question)
            broken = self._answers.broken(name)
            described = _merged(described, answer or Description())
        return Script(
            file=name,
            label=(section.display_name or described.label or name)[:_LONGEST_NAME],
            command=command,
            folder=section.cwd or folder,
            settings=self._settings(name, section, described, ours=ours),
            summary=described.summary,
            main=tuple(described.main),
            dependencies=_dependencies(name, section, described),
            environment={**self._login, **section.env},
            ours=ours,
            broken=broken,
        )

    def _is_ours(self, name: str, entry: Path, section: ScriptSection) -> tuple[bool, str]:
        """Whether it is ours, and why it cannot be started; parsed only when it has changed, which may take a second.

        What another Python runs may be written for that.
        """
        before, now = self._ours.get(name), stamp(entry)
        if before is not None and before[0] == now:
            return before[1:]
        ours, broken = False, ""
        try:
            ours = is_ours(entry)
        except BrokenScriptError as error:
            if section.python is None:
                broken = str(error)
                log.warning("%s cannot be started: %s", name, broken)
        self._ours[name] = (now, ours, broken)
        return ours, broken

    def _command(
        self, folder: Path, entry: Path, section: ScriptSection, described: Description, *, ours: bool
    ) -> tuple[str, ...]:
        """The command line without options."""
        if described.command:
            program, *more = described.command
            return (str(folder / program) if "/" in program else program, *more)
        python = section.python
        if python is None and entry.suffix != ".py" and os.access(entry, os.X_OK):
            return (str(entry),)
        if python is not None and "/" in python:
            python = str(self._config.folder / in_home(python))
        return (interpreter(python, ours=ours), str(entry))

    def _settings(
        self, name: str, section: ScriptSection, described: Description, *, ours: bool
    ) -> tuple[Setting, ...]:
        """By key: the config's, then the script's own. One of ours knows its options best."""
        configured = [Setting(**asdict(argument)) for argument in section.args]
        own = {setting.key: setting for setting in described.configs}
        if ours and own:
            unknown = [setting.key for setting in configured if setting.key not in own]
            if unknown:
                self._complain(name, "%s has no setting %s: ignored", name, ", ".join(unknown))
            configured = [_with_option(setting, own[setting.key]) for setting in configured if setting.key in own]
        merged = {setting.key: setting for setting in configured}
        for setting in own.values():
            merged.setdefault(setting.key, setting)
        settings = tuple(merged.values())
        size = len(msgspec.json.encode(form(settings)))
        if len(settings) > MAX_SETTINGS or size > _LONGEST_FORM:
            self._complain(name, "%s is offered without settings: %d are too many", name, len(settings))
            return ()
        return settings

    def _complain(self, name: str, text: str, *values: object) -> None:
        """Log a warning, once for each script."""
        if name not in self._complained and len(self._complained) < MAX_SCRIPTS:
            self._complained.add(name)
            log.warning(text, *values)


def files(scripts: Iterable[Script]) -> list[dict[str, object]]:
    """The ``files`` of `autonomy-files`; without a form where all would be too long."""
    entries: list[dict[str, object]] = []
    left = _LONGEST_FILES
    for script in scripts:
        configs = form(script.settings)
        left -= len(msgspec.json.encode(configs))
        configs = configs if left >= 0 else []
        entries.append({"file": script.file, "label": script.label, "configs": configs, **_first_seen(script, configs)})
    return entries


def _first_seen(script: Script, configs: Iterable[Mapping[str, object]]) -> dict[str, object]:
    """What operators read of it before its settings, and which of these they see first; only what it says itself."""
    keys = {setting["key"] for setting in configs}
    first = {"summary": script.summary, "main": [key for key in script.main if key in keys]}
    return {name: value for name, value in first.items() if value}


def _inside(root: Path) -> list[Path]:
    try:
        return [folder for folder in root.iterdir() if folder.is_dir()]
    except OSError:  # most often there is none
        return []


def _manifest(path: Path) -> Description:
    return read_manifest(path) or Description()


def _merged(first: Description, second: Description) -> Description:
    """What ``first`` leaves open is taken from ``second``."""
    keys = {setting.key for setting in first.configs}
    return Description(
        label=first.label or second.label,
        summary=first.summary or second.summary,
        main=first.main or second.main,
        configs=[*first.configs, *(setting for setting in second.configs if setting.key not in keys)][:MAX_SETTINGS],
        dependencies=first.dependencies or second.dependencies,
    )


def _with_option(configured: Setting, own: Setting) -> Setting:
    return replace(configured, arg=own.arg, arg_false=own.arg_false, mode=own.mode)


def _dependencies(name: str, section: ScriptSection, described: Description) -> tuple[Dependency, ...]:
    """The config's, else the script's own; each script once, and never itself."""
    chosen: Iterable[tuple[str, Mapping[str, object]]]
    if section.dependencies:
        chosen = ((each.file, each.config) for each in section.dependencies if each.enabled)
    else:
        chosen = ((each.file, each.config) for each in described.dependencies)
    by_file = {file: Dependency(file, dict(config)) for file, config in chosen if file != name}
    return tuple(by_file.values())[:_MAX_DEPENDENCIES]

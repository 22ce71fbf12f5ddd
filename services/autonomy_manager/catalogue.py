"""Which scripts there are: folders with an entry point, what the config lists, what they publish about themselves."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec.structs import asdict, replace

import pebble
from pebble.config import Config
from pebble.config.autonomy import Script as ScriptSection
from pebble.config.home import in_home
from pebble.contract.identity import meant
from pebble.services.autonomy_manager import builtin_forms
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
from pebble.services.autonomy_manager.forms import MAX_SETTINGS, Setting, form
from pebble.services.autonomy_manager.local_media import LocalMedia
from pebble.services.autonomy_manager.needs import HALL_OPTION, Needs, needs_of
from pebble.services.autonomy_manager.pythons import Pythons
from pebble.services.autonomy_manager.script import Dependency, Script

MAX_SCRIPTS = 256
_LONGEST_NAME = 100
_LONGEST_FORM = 16 * 1024  # bytes
_LONGEST_FILES = 256 * 1024  # bytes of all forms together
_MAX_DEPENDENCIES = 8
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

    def __init__(self, config: Config, *, pythons: Pythons | None = None, asks: bool = True) -> None:
        """``asks`` is False for a list of scripts without the settings of ours."""
        self._config, self._section, self._asks = config, config.services.autonomy_manager, asks
        self._roots = roots(config)
        self._own = self._roots[-1] if len(self._roots) > 1 else None
        self._pythons, self._media = pythons or Pythons(), LocalMedia(config)
        self._needs: dict[Path, tuple[object, Needs]] = {}  # by entry point, of scripts that are not ours
        self._manifests, self._answers = Descriptions(), Descriptions()
        self._ours: dict[str, tuple[object, bool, str]] = {}  # by name: version, whether it is ours, what is wrong
        self._scanned = False
        self._complained: set[str] = set()  # names with a warning in the log

    def scan(self, found: Callable[[dict[str, Script]], object]) -> None:
        """Call ``found`` with all scripts; the first time also with those so far, before one is asked."""
        folders = dict(self._folders())
        scripts: dict[str, Script] = {}
        for name, places in folders.items():
            script = self._first_able(name, places, lambda: self._scanned or found(dict(scripts)))
            if script is not None:
                scripts[name] = script
        known = {*folders, *map(_own_key, folders)}
        for descriptions in (self._manifests, self._answers):
            descriptions.retain_only(known)
        self._ours = {key: answer for key, answer in self._ours.items() if key in known}
        self._needs = {entry: needs for entry, needs in self._needs.items() if entry.parent.name in folders}
        self._scanned = True
        found(scripts)

    def _first_able(self, name: str, folders: Sequence[Path], before_asking: Callable[[], object]) -> Script | None:
        """The script in the first folder; but Pebble's own where that one cannot run here."""
        script = self._script(name, folders[0], before_asking)
        if script is None and len(folders) > 1:
            return self._first_able(name, folders[1:], before_asking)
        if script is None or not script.broken or folders[0].parent == self._own:
            return script
        if folders[-1].parent == self._own:
            own = self._script(name, folders[-1], before_asking, own=True)
            if own is not None and not own.broken:
                text = "%s in %s cannot run here: %s; Pebble's own %s is offered instead"
                self._complain(name, text, name, folders[0].parent, script.broken, name)
                return replace(own, instead_of=script.broken)
        elif (_OWN_SCRIPTS / name).is_dir():
            hint = f"; Pebble's own {name} does the same: write a relative autonomy_root, and it is offered"
            return replace(script, broken=script.broken + hint)
        return script

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

    def _script(
        self, name: str, folder: Path, before_asking: Callable[[], object], *, own: bool = False
    ) -> Script | None:
        """``own``: Pebble's own instead of the robot's copy, for which the config says how to run it."""
        section = self._section_of(name)
        key = name
        if own:
            section, key = replace(section, entrypoint="run.py", python=None, cwd=None), _own_key(name)
        entry, manifest = folder / section.entrypoint, folder / MANIFEST
        described = self._manifests.get(key, [manifest], lambda: _manifest(manifest)) or Description()
        if not described.command and not entry.is_file():
            return None
        ours, broken = (False, "") if described.command else self._is_ours(key, entry, section)
        variables = environment(self._section.env, section.env)
        needs = Needs() if ours or described.command or broken else self._needs_of(entry)
        command, lacking = self._command(name, folder, entry, section, described, needs, variables)
        working = section.cwd or folder
        broken = broken or lacking or self._media.lacks(needs, folder, working)
        if ours and self._asks:

            def question() -> Description:
                before_asking()
                return ask(command, folder, variables)

            answer = self._answers.get(key, [entry], question)
            broken = self._answers.broken(key)
            described = _merged(described, answer or Description())
        settings = self._settings(name, section, described, ours=ours)
        login = local_login(self._config) if ours or not section.arbitrate else {}  # the others get the gate's
        return Script(
            file=name,
            label=(section.display_name or described.label or name)[:_LONGEST_NAME],
            command=command,
            folder=working,
            settings=settings,
            summary=described.summary,
            main=tuple(described.main),
            dependencies=_dependencies(name, section, described, ours=ours),
            environment={**login, **self._section.env, **section.env},
            ours=ours,
            arbitrate=section.arbitrate,
            broken=broken,
            needs=needs,
            size=self._media.size if needs.pictures else None,
            more=self._media.hall_options if needs.hall and HALL_OPTION not in _options(settings) else (),
        )

    def _needs_of(self, entry: Path) -> Needs:
        """Read again only when one of its files has changed, which may take a second."""
        if entry.suffix != ".py":
            return Needs()
        before = self._needs.get(entry)
        if before is not None and before[0] == [stamp(file) for file in before[1].files]:
            return before[1]
        needs = needs_of(entry)
        self._needs[entry] = ([stamp(file) for file in needs.files], needs)
        return needs

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
        self,
        name: str,
        folder: Path,
        entry: Path,
        section: ScriptSection,
        described: Description,
        needs: Needs,
        variables: Mapping[str, str],
    ) -> tuple[tuple[str, ...], str]:
        """The command line without options, and why it cannot be started."""
        if described.command:
            program, *more = described.command
            return (str(folder / program) if "/" in program else program, *more), ""
        python = section.python
        if python is None and entry.suffix != ".py" and os.access(entry, os.X_OK):
            return (str(entry),), ""
        if python is not None and "/" in python:
            python = str(self._config.folder / in_home(python))
        chosen, lacking = self._pythons.choose(name, python, needs, folder, variables)
        return (chosen, str(entry)), lacking

    def _settings(
        self, name: str, section: ScriptSection, described: Description, *, ours: bool
    ) -> tuple[Setting, ...]:
        """By key: the config's, then the script's own, then the built-in ones. One of ours knows its options best."""
        configured = [Setting(**asdict(argument)) for argument in section.args]
        own = {setting.key: setting for setting in described.configs}
        if ours and own:
            unknown = [setting.key for setting in configured if setting.key not in own]
            if unknown:
                self._complain(name, "%s has no setting %s: ignored", name, ", ".join(unknown))
            configured = [_with_option(setting, own[setting.key]) for setting in configured if setting.key in own]
        merged = {setting.key: setting for setting in configured}
        camera = self._config.services.av_daemon.video
        known = () if ours else builtin_forms.settings_of(name, camera)
        for setting in (*own.values(), *known):
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


def _own_key(name: str) -> str:
    return f"Pebble's own {name}"


def _options(settings: Iterable[Setting]) -> set[str | None]:
    return {setting.arg for setting in settings}


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


def _dependencies(name: str, section: ScriptSection, described: Description, *, ours: bool) -> tuple[Dependency, ...]:
    """The config's, else the script's own, else the built-in ones; each script once, and never itself."""
    chosen: Iterable[tuple[str, Mapping[str, object]]]
    if section.dependencies:
        chosen = ((each.file, each.config) for each in section.dependencies if each.enabled)
    elif described.dependencies:
        chosen = ((each.file, each.config) for each in described.dependencies)
    else:
        chosen = () if ours else builtin_forms.DEPENDENCIES.get(name, ())
    by_file = {file: Dependency(file, dict(config)) for file, config in chosen if file != name}
    return tuple(by_file.values())[:_MAX_DEPENDENCIES]

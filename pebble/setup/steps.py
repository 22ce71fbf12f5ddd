"""Steps of a set-up as data, and the engine that does them, any number of times, and undoes them.

A step that was done is the *same*; a file that was changed by hand is never overwritten. All that is written is in the
manifest before it is written, so a set-up that was killed goes on where it was.
"""

import grp
import os
import pwd
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from pebble.errors import PebbleError
from pebble.fleet.whole_file import is_root, write
from pebble.setup import manifest as manifests
from pebble.setup.manifest import Manifest, SetupError, content_of, sha256
from pebble.setup.places import Places

BESIDE = ".pebble-new"
_COMMAND_S = 120.0


class State(StrEnum):
    """How a step finds the machine."""

    NEW = "new"
    SAME = "same"
    BY_HAND = "changed by hand"
    CANNOT = "cannot"
    SKIPPED = "skipped"  # it concerns the running machine, and the root is another


class Result(NamedTuple):
    """What became of one step, or would."""

    step: "Step"
    state: State
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One thing that must be so: a folder, a file, a folder made with its files, a command that ran, or an act of ours.

    ``content``: of a file; a function makes it once, and what is there then stays. ``check`` raises PebbleError before
    it is written. ``make`` fills a new folder.
    ``of``: files for which ``command`` runs again when they change. ``changes``: files that ``act`` writes.
    ``undo`` runs before files are removed, ``after`` afterwards. ``cannot``: why this machine does not allow the step.
    """

    what: str
    target: Path | None = None
    content: bytes | Callable[[], bytes] | None = None
    make: Callable[[Path], None] | None = None
    check: Callable[[bytes], None] | None = None
    mode: int = 0o644
    owner: str = "root:root"
    command: tuple[str, ...] = ()
    of: tuple[Path, ...] = ()
    act: Callable[[], None] | None = None
    done: Callable[[], bool] | None = None
    changes: tuple[Path, ...] = ()
    undo: tuple[str, ...] = ()
    undo_act: Callable[[], None] | None = None
    after: tuple[str, ...] = ()
    cannot: str = ""
    live: bool = False  # it concerns the machine that runs, not files below a root

    @property
    def is_folder(self) -> bool:
        return self.target is not None and self.content is None and self.make is None


def run_command(command: Sequence[str]) -> None:
    """Run a program of the system. Raises SetupError with its first line of complaint."""
    line = " ".join(command)
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_COMMAND_S)
    except OSError as error:
        raise SetupError(f"`{line}`: {error.strerror}") from None
    except subprocess.TimeoutExpired:
        raise SetupError(f"`{line}` did not end within {_COMMAND_S:g} s") from None
    if done.returncode != 0:
        complaint = (done.stderr.strip() or done.stdout.strip() or "it failed").splitlines()[0]
        raise SetupError(f"`{line}`: {complaint}")


@dataclass
class Engine:
    """Does steps below one root. ``run`` starts programs of the system."""

    places: Places
    manifest: Manifest
    run: Callable[[Sequence[str]], None] = run_command
    is_live: bool = False  # whether this is the machine that runs, of which services can be started
    _applied: set[Path] = field(default_factory=set)

    def begin(self) -> None:
        """Write the manifest before anything else."""
        self._save()

    def finish(self, left: Mapping[str, str]) -> None:
        """Note that a backup is restored, and forget the earlier names whose last step, in ``left``, is done."""
        self.manifest.restoring = ""
        for robot in [robot for robot in self.manifest.leaving if left[robot] in self.manifest.ran]:
            self.manifest.leaving.remove(robot)
            del self.manifest.ran[left[robot]]
        self._save()

    def forget(self) -> None:
        """Forget what :meth:`states` expected."""
        self._applied.clear()

    # -- forwards

    def states(self, steps: Iterable[Step]) -> Iterator[Result]:
        """How each step finds the machine; writes nothing."""
        for step in steps:
            state, why = self._state(step)
            if state is State.NEW:
                self._applied.update(filter(None, (step.target, *step.changes)))
            yield Result(step, state, why)

    def apply(self, steps: Sequence[Step]) -> Iterator[Result]:
        """Do each step that is not done; one that fails does not keep the others from being done."""
        self._save()
        for step in (*self.left_over(steps), *steps):
            state, why = self._state(step)
            try:
                if state is State.NEW:
                    self._do(step)
                    self._applied.update(filter(None, (step.target, *step.changes)))
                elif state is State.BY_HAND and why:
                    self._put_beside(step)
                else:
                    self._note_same(step, state)
            except (PebbleError, OSError) as error:
                state, why = State.CANNOT, _reason(error)
            yield Result(step, state, why)
        self._save()

    def left_over(self, steps: Sequence[Step]) -> list[Step]:
        """Steps that remove what earlier answers needed, and these do not."""
        wanted = [self._name(step.target) for step in steps if step.target is not None]
        used = {*wanted, *(name + BESIDE for name in wanted)}
        made = tuple(f"{self._name(step.target)}/" for step in steps if step.make is not None and step.target)
        names = [name for name in self.manifest.files if name not in used and not name.startswith(made or "\0")]
        return [
            Step(what=f"remove {name}, which is not needed now", act=lambda name=name: self._remove(name))  # type: ignore[misc]
            for name in names
            if self._is_removable(name)
        ]

    def _state(self, step: Step) -> tuple[State, str]:
        if step.live and not self.is_live:
            return State.SKIPPED, f"{self.places.root} is not the system that runs"
        if step.cannot:
            return State.CANNOT, step.cannot
        try:
            state = self._found(step)
            return state, self._beside(step) if state is State.BY_HAND else ""
        except PermissionError as error:
            return State.CANNOT, f"{error.filename} may not be read by this user: use sudo"
        except (OSError, PebbleError) as error:
            return State.CANNOT, _reason(error)

    def _beside(self, step: Step) -> str:
        """Where our content goes; empty: it is that which was changed, so it is of no use."""
        assert step.target is not None  # noqa: S101 - only files are changed by hand
        known = isinstance(step.content, bytes) and self.manifest.is_ours(self._name(step.target), step.content)
        return "" if known else f"ours is {self._name(step.target)}{BESIDE}"

    def _found(self, step: Step) -> State:
        if step.target is not None and (step.is_folder or step.make is not None):
            return State.SAME if step.target.is_dir() and self._is_given(step, step.target) else State.NEW
        if step.target is not None:
            return self._file_state(step)
        if any(self.manifest.is_changing(self._name(path)) for path in step.changes):
            return State.NEW
        if step.done is not None and not step.done():
            return State.NEW
        if step.command and (step.of or step.done is None):
            fresh = self.manifest.ran.get(step.what) == self._digest(step) and not self._applied & {*step.of}
            return State.SAME if fresh else State.NEW
        return State.SAME if step.done is not None else State.NEW

    def _is_given(self, step: Step, folder: Path) -> bool:
        """Whether a folder of ours has its owner, who may not have been there when it was made."""
        owner = self.owner(step.owner) if self._name(folder) in self.manifest.folders else None
        found = folder.stat()
        return owner is None or owner == (found.st_uid, found.st_gid)

    def _file_state(self, step: Step) -> State:
        target = step.target
        assert target is not None  # noqa: S101 - by the caller
        try:
            current = target.read_bytes()
        except FileNotFoundError:
            return State.NEW
        if not isinstance(step.content, bytes) or current == step.content:
            return State.SAME
        return State.NEW if self.manifest.is_ours(self._name(target), current) else State.BY_HAND

    def _do(self, step: Step) -> None:
        if step.target is not None and step.make is not None:
            self._make_folder(step.target, step)
        elif step.target is not None and step.is_folder and step.target.is_dir():
            manifests.finish_folder(step.target, step.mode, self.owner(step.owner))
        elif step.target is not None and step.is_folder:
            self._parents(step.target)
            self._folder(step.target, step.mode, self.owner(step.owner))
        elif step.target is not None:
            content = step.content() if callable(step.content) else step.content
            if step.check is not None:
                step.check(content or b"")
            self._write(step.target, content or b"", step)
        else:
            self._intend(step.changes)
            if step.act is not None:
                step.act()
            if step.command:
                self.run(step.command)
                self.manifest.ran[step.what] = self._digest(step)
            for path in step.changes:
                self.manifest.wrote(self._name(path), path.read_bytes())
            self._save()

    def _write(self, target: Path, content: bytes, step: Step) -> None:
        name = self._name(target)
        self._parents(target)
        self.manifest.intend(name, content)
        self._save()
        write(target, content, step.mode, SetupError, self.owner(step.owner))
        self.manifest.wrote(name, content)

    def _put_beside(self, step: Step) -> None:
        """Write what we would have written beside what was changed by hand."""
        assert step.target is not None  # noqa: S101 - only files are changed by hand
        beside = step.target.with_name(step.target.name + BESIDE)
        if not beside.exists() or beside.read_bytes() != step.content:
            self._write(beside, bytes(step.content or b""), step)  # type: ignore[arg-type]

    def _note_same(self, step: Step, state: State) -> None:
        """Forget the content before, if setup was killed after it had replaced it."""
        target = step.target
        if state is not State.SAME or target is None:
            return
        name, folder = self._name(target), f"{self._name(target)}/"
        for one in [one for one in self.manifest.files if one == name or one.startswith(folder)]:
            path = self.places.root / one[1:]
            several = path.is_file() and len(self.manifest.files[one]) > 1 and not self.manifest.is_changing(one)
            if several and self.manifest.is_ours(one, content := content_of(path)):
                self.manifest.wrote(one, content)

    def _make_folder(self, target: Path, step: Step) -> None:
        """Fill a folder beside it, and put it in its place whole."""
        self._parents(target)
        new = target.with_name(f".{target.name}.new")
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(mode=0o700)
        assert step.make is not None  # noqa: S101 - by the caller
        step.make(new)
        owner = self.owner(step.owner)
        for path in sorted(new.iterdir()):
            self.manifest.intend(self._name(target / path.name), content_of(path))
            if owner is not None:
                os.chown(path, *owner, follow_symlinks=False)
        self._note_folder(target)
        manifests.finish_folder(new, step.mode, owner)
        new.rename(target)
        for path in target.iterdir():
            self.manifest.wrote(self._name(path), content_of(path))

    def _parents(self, target: Path) -> None:
        for folder in reversed(target.parents):
            if folder != self.places.etc and not folder.exists():
                self._folder(folder, 0o755, self.owner("root:root"))

    def _folder(self, folder: Path, mode: int, owner: tuple[int, int] | None) -> None:
        self._note_folder(folder)
        new = folder.with_name(f".{folder.name}.new")
        if new.exists():
            new.rmdir()
        new.mkdir(mode=0o700)
        manifests.finish_folder(new, mode, owner)
        new.rename(folder)

    def _note_folder(self, folder: Path) -> None:
        name = self._name(folder)
        if name not in self.manifest.folders:
            self.manifest.folders.append(name)
        self._save()

    def _intend(self, changes: Iterable[Path]) -> None:
        for path in changes:
            self.manifest.intend(self._name(path), None)
        self._save()

    def _digest(self, step: Step) -> str:
        parts = [" ".join(step.command).encode()]
        parts += [path.read_bytes() if path.is_file() else b"" for path in step.of]
        return sha256(b"\0".join(parts))

    def owner(self, owner: str) -> tuple[int, int] | None:
        """The ids of ``user:group``; None: files stay ours. Raises SetupError."""
        if not self.is_live or not is_root():
            return None
        user, _, group = owner.partition(":")
        try:
            return pwd.getpwnam(user).pw_uid, grp.getgrnam(group).gr_gid
        except KeyError:
            raise SetupError(f"there is no user {user} or no group {group} on this machine") from None

    def _save(self) -> None:
        try:
            owner = self.owner("root:pebble")
        except SetupError:
            owner = None  # the user comes later
        manifests.save(self.places, self.manifest, owner)

    def _name(self, path: Path) -> str:
        return self.places.named(path)

    # -- backwards

    def undo(self, steps: Sequence[Step], *, purge: bool, dry: bool = False) -> Iterator[tuple[str, State, str]]:
        """Undo what the manifest names: (what, state, why). ``purge``: also what was changed by hand, and the state."""
        backwards = list(reversed(steps))
        for step in backwards:
            if step.undo and step.what in self.manifest.ran:
                yield self._undone(" ".join(step.undo), lambda step=step: self.run(step.undo), step, dry)  # type: ignore[misc]
            if step.undo_act is not None:
                yield self._undone("remove the robot's retained messages", step.undo_act, step, dry)
        for name in sorted(self.manifest.files, reverse=True):
            path = self.places.root / name[1:]
            if not (path.exists() or path.is_symlink()):
                continue
            if not purge and not self._is_removable(name):
                yield f"{name} stays", State.BY_HAND, "it was changed after setup wrote it"
            else:
                yield self._undone(f"remove {name}", lambda name=name: self._remove(name), None, dry)  # type: ignore[misc]
        if purge and self.places.state.exists():
            erase = f"erase {self._name(self.places.state)}"
            yield self._undone(erase, lambda: shutil.rmtree(self.places.state), None, dry)
        if not dry:
            self._remove_folders()
        for step in backwards:
            if step.after and step.what in self.manifest.ran:
                yield self._undone(" ".join(step.after), lambda step=step: self.run(step.after), step, dry)  # type: ignore[misc]

    def _undone(self, what: str, act: Callable[[], None], step: Step | None, dry: bool) -> tuple[str, State, str]:
        if step is not None and step.live and not self.is_live:
            return what, State.SKIPPED, f"{self.places.root} is not the system that runs"
        if dry:
            return what, State.NEW, ""
        try:
            act()
        except (PebbleError, OSError) as error:
            return what, State.CANNOT, _reason(error)
        return what, State.NEW, ""

    def _is_removable(self, name: str) -> bool:
        try:
            return self.manifest.is_ours(name, content_of(self.places.root / name[1:]))
        except OSError:
            return False

    def _remove(self, name: str) -> None:
        path = self.places.root / name[1:]
        path.unlink(missing_ok=True)
        self.manifest.files.pop(name, None)
        folder, etc = path.parent, self.places.etc
        if folder != etc and self._name(folder) in self.manifest.folders and not any(folder.iterdir()):
            folder.rmdir()
            self.manifest.folders.remove(self._name(folder))
        self._save()

    def _remove_folders(self) -> None:
        """Remove the folders that setup made and that are empty now, and last the manifest."""
        own = self._name(self.places.etc)
        for name in sorted(self.manifest.folders, reverse=True):
            folder = self.places.root / name[1:]
            if name != own and folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        self.places.manifest.unlink(missing_ok=True)
        if own in self.manifest.folders and not any(self.places.etc.iterdir()):
            self.places.etc.rmdir()


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{error.filename or ''}: {error.strerror}".removeprefix(": ")
    return str(error).splitlines()[0]

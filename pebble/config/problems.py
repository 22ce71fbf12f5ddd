"""Problems and warnings of a config file: collected while it is read, reported all at once."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from pebble.config.secret_text import without_secrets

Path = tuple[str | int, ...]
_ALIKE = 0.6  # of 1.0, which is equal
_FEW_REASONS = 2  # why keys are no longer used: more reasons are not told; a file of the original has a dozen


class Note(NamedTuple):
    """A remark about one place of the file."""

    path: Path
    text: str

    def __str__(self) -> str:
        return without_secrets(f"{show_path(self.path)}: {self.text}")


class Notes:
    """Problems, for which the file is refused, and warnings."""

    def __init__(self) -> None:
        self.problems: list[Note] = []
        self.warnings: list[Note] = []
        self.retired: list[Note] = []  # text: what replaces the key

    def problem(self, path: Path, text: str) -> None:
        self.problems.append(Note(path, text))

    def doubt(self, path: Path, text: str) -> None:
        """Note a problem, unless one is already noted at this place or around it, which may be the cause."""
        if not any(note.path == path[: len(note.path)] for note in self.problems):
            self.problem(path, text)

    def warning(self, path: Path, text: str) -> None:
        self.warnings.append(Note(path, text))

    def forget_inherited(self, written: Any, merged: Any) -> None:
        """Remove notes about values that a serial line inherits: they are noted at the section that has them.

        ``merged`` is ``written`` with the inherited values (raw.with_instances). All other notes stay.
        """
        for notes in (self.problems, self.warnings, self.retired):
            notes[:] = [note for note in notes if holds(written, note.path) or not holds(merged, note.path)]

    def warning_lines(self) -> tuple[str, ...]:
        """Return one line per warning; keys that are no longer used share a line."""
        return (*_unused(self.retired), *map(str, self.warnings))


def _unused(retired: list[Note]) -> Iterator[str]:
    """Yield lines such as ``video.shm_size, video.io_mode: no longer used, …``; many keys share one line."""
    reasons = dict.fromkeys(note.text for note in retired)
    if len(reasons) > _FEW_REASONS:
        paths = (tuple(step for step in note.path if isinstance(step, str)) for note in retired)  # no places in lists
        names = ", ".join(dict.fromkeys(show_path(path[-2:]) for path in paths))
        yield without_secrets(f"no longer used, delete them: {names}; `pebble check --keys` says what replaces each")
        return
    for reason in reasons:
        places = ", ".join(show_path(note.path) for note in retired if note.text == reason)
        yield without_secrets(f"{places}: no longer used, {reason}")


def show_path(path: Path) -> str:
    """Return a path as text, such as ``web_interface.robots[0].id``."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return text.removeprefix(".") or "(the whole file)"


def holds(raw: Any, path: Path) -> bool:
    """True if there is a value at ``path``."""
    for step in path:
        keys: Any = raw if isinstance(raw, Mapping) else ()
        if isinstance(raw, list):
            keys = range(len(raw))
        if step not in keys:
            return False
        raw = raw[step]
    return True


def near(key: str, known: Iterable[str], likeness: float = _ALIKE) -> str:
    """Return the known key that is most similar to ``key``, or "" if none is similar enough."""
    from difflib import get_close_matches  # only a file with a mistake pays for this import

    return next(iter(get_close_matches(key, sorted(known), n=1, cutoff=likeness)), "")


def nearest(key: str, known: Iterable[str]) -> str:
    """Return the text after "unknown key": the most similar known key, or all keys if none is similar."""
    names = sorted(known)
    if close := near(key, names):
        return f'did you mean "{close}"?'
    if len(names) == 1:
        return f'the only one is "{names[0]}"'
    return f'the nearest is "{near(key, names, 0.0)}" of {", ".join(names)}'

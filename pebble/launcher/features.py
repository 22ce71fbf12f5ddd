"""The features that the robot's processes report by notes to the launcher, for the capabilities message. Pure."""

from collections.abc import Callable

from pebble.runtime.notes import Feature

#: A robot has these unless a process reports that it lacks them. It has other features while a process reports them.
_EXPECTED = frozenset({"estop", "control"})
_MOST_REPORTS = 256  # of all processes; a self-describing MCU names its own outlets


class Features:
    """The newest Feature notes of all programs; ``on_change()`` is called when a property changes.

    ``estop``: the emergency stop. ``control``: requests for control are answered. ``outlets/NAME/status`` and
    ``outlets/NAME/power``: the contract's topics of a power outlet are in use.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._reports: set[tuple[str, str]] = set()  # program, feature: only those that differ from what is expected

    @property
    def lacking(self) -> frozenset[str]:
        """Features among ``estop`` and ``control`` that at least one process lacks."""
        return self._reported & _EXPECTED

    @property
    def found(self) -> frozenset[str]:
        """Features other than ``estop`` and ``control`` that at least one process has."""
        return self._reported - _EXPECTED

    def receive(self, program: str, note: Feature) -> None:
        """Handle a note of ``program``: remember it while it differs from :data:`_EXPECTED`."""
        report = program, note.name
        is_as_expected = note.has == (note.name in _EXPECTED)  # a robot has it, or lacks it, without any report
        if is_as_expected:
            self._set(self._reports - {report})
        elif len(self._reports) < _MOST_REPORTS:
            self._set(self._reports | {report})

    def ended(self, program: str) -> None:
        """Forget the reports of a program that has ended."""
        self._set({report for report in self._reports if report[0] != program})

    @property
    def _reported(self) -> frozenset[str]:
        return frozenset(feature for _, feature in self._reports)

    def _set(self, reports: set[tuple[str, str]]) -> None:
        before, self._reports = self._reported, reports
        if self._reported != before:
            self._on_change()

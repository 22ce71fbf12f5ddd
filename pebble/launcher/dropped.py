"""How many messages the robot's processes have dropped because a bound was reached, as they report it. Pure."""

import re

_MOST = 16  # reasons of one process

_report = re.compile(r"DROPPED((?: [a-z_]{1,32}=[0-9]{1,15})+)").fullmatch


class Dropped:
    """Handles ``DROPPED <reason>=<number> …``: all of a process since its start."""

    def __init__(self) -> None:
        self._counts: dict[str, dict[str, int]] = {}  # by program

    def __getitem__(self, program: str) -> dict[str, int]:
        """By reason; empty if nothing was dropped."""
        return self._counts.get(program, {})

    def receive(self, program: str, line: str) -> bool:
        """Handle a note of ``program``; False if it is none of these."""
        match = _report(line)
        if match is None:
            return False
        pairs = (pair.split("=") for pair in match[1].split()[:_MOST])
        self._counts[program] = {reason: int(number) for reason, number in pairs}
        return True

    def ended(self, program: str) -> None:
        self._counts.pop(program, None)

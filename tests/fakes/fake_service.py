"""A child process for launcher tests: ``fake_service NAME BEHAVIOUR JOURNAL``. It writes its events to JOURNAL."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from pebble.config import config_of_process
from pebble.runtime.parent import NOTIFY_FD, WANTED, Notifier


def note(event: str) -> None:
    name, _, journal = sys.argv[1:4]
    with Path(journal).open("a") as out:
        out.write(f"{name} {event} {os.getpid()}\n")


def stop(*_: object) -> None:
    note("stop")
    sys.exit(0)


def live(notify: Notifier, *, alive: bool = True) -> None:
    note("ready")
    notify.ready()
    while True:
        time.sleep(0.05)
        if alive:
            notify.alive()


def ask(notify: Notifier) -> None:
    """Send the requests that a test appends to the file ``JOURNAL.orders.NAME``: ``media 1 h264``.

    ``lacks estop`` and ``has estop`` are reports; ``hold media 1`` lets it wait.
    """
    orders = Path(f"{sys.argv[3]}.orders.{sys.argv[1]}")
    orders.write_text("")  # those of the previous process are old
    note("before:" + ",".join(os.environ.get(WANTED, "").split()))
    note("ready")
    notify.ready()
    with orders.open() as lines:
        while True:
            for line in lines:
                first, *rest = line.split()
                if first in ("lacks", "has"):
                    notify.feature(rest[0], first == "has")
                elif first == "hold":
                    notify.hold(rest[0], rest[1] == "1")
                else:
                    notify.request(first, rest[0] == "1", *rest[1:])
            notify.alive()
            time.sleep(0.01)


def end(how: str) -> None:
    """End in one of the ways in which a Python program can end by itself."""
    if how == "crash":
        sys.exit(3)
    if how == "word":
        sys.exit("a last word")
    if how == "raise":
        raise RuntimeError("nobody catches this")
    if how == "done":
        atexit.register(lambda: note("atexit"))
        threading.Thread(target=lambda: (time.sleep(0.2), note("thread"))).start()


def report_environment() -> None:
    """Write down the descriptors and signals that the program finds."""
    found = {number: Path(f"/proc/self/fd/{number}") for number in range(1024)}
    kinds = (f"{number}={path.readlink().name.partition(':')[0]}" for number, path in found.items() if path.exists())
    note("fds:" + ",".join(kinds))
    note("mask:" + ",".join(map(str, signal.pthread_sigmask(signal.SIG_BLOCK, ()))))
    note("handler:" + str(signal.getsignal(signal.SIGHUP).name))
    note("group:" + str(os.getpgrp() == os.getpid()))


def main() -> None:
    behaviour = sys.argv[2]
    if behaviour == "curious":
        report_environment()
    signal.signal(signal.SIGTERM, signal.SIG_IGN if behaviour == "stubborn" else stop)
    note("start")
    if behaviour in ("crash", "word", "raise", "done"):
        end(behaviour)
        return
    if behaviour == "parent":
        os.environ.pop(NOTIFY_FD)
        child = subprocess.Popen(["sleep", "600"])
        note(f"child:{child.pid}")
        os._exit(1)
    if behaviour == "asker":
        ask(Notifier())
    if behaviour == "environment":
        note("systemd:" + str("NOTIFY_SOCKET" in os.environ))
    if behaviour == "configured":
        note("config:" + config_of_process(Path(sys.argv[3]).with_name("rover.json")).base)
    live(Notifier(), alive=behaviour != "mute")


if __name__ == "__main__":
    main()

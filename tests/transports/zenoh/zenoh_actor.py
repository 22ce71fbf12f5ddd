"""Processes of a robot that do one thing each: `python -m tests.transports.zenoh.zenoh_actor ROLE RUN_DIR`.

Each prints `up` when it is ready; a line on stdin ends it, and asks for its result where it has one.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from pebble.errors import TransportError
from pebble.transports import Message, QoS, Transport, ZenohSettings, create

DELIVERED = QoS.DELIVERED


def main(role: str, run_dir: str) -> None:
    client = create("zenoh", role, ZenohSettings(run_dir=Path(run_dir))).open(5)
    globals()[role](client)


def report(text: object) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def listener(client: Transport) -> None:
    """Reports how many messages it has received and the last one, for each line on stdin."""
    received: list[Message] = []
    client.subscribe("#", received.append)
    report("up")
    for _ in sys.stdin:
        report(f"{len(received)} {received[-1].payload.decode() if received else ''}")
    client.close()


def forks(client: Transport) -> None:
    """The child may neither use its parent's session nor open one."""
    report("up")
    child = os.fork()
    if child == 0:
        _exit(_refusals(client))
    _, status = os.waitpid(child, 0)
    report(os.waitstatus_to_exitcode(status))
    client.close()


def forks_with_a_lock(client: Transport) -> None:
    """The child ends as any program; at that moment another thread of its parent held a lock, for good."""
    held = threading.Event()
    client.on_state(lambda _state: (held.set(), threading.Event().wait()))
    threading.Thread(target=client.close, daemon=True).start()
    held.wait()
    report("up")
    if child := os.fork():
        _, status = os.waitpid(child, 0)
        report(os.waitstatus_to_exitcode(status))
        _exit(0)


def _exit(code: int) -> None:
    """End at once, whatever is open."""
    os.execlp("sh", "sh", "-c", f"exit {code}")


def _refusals(client: Transport) -> int:
    attempts = (
        lambda: client.publish("from/child", b""),
        lambda: client.subscribe("to/child", print),
        lambda: create("zenoh", "child", client.settings).open(1),  # type: ignore[attr-defined]
    )
    return sum(_is_refused(attempt) for attempt in attempts)


def _is_refused(attempt: object) -> bool:
    try:
        attempt()  # type: ignore[operator]
    except TransportError as error:
        return "spawn" in str(error)
    return False


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Processes of a robot that do one thing each: `python -m tests.transports.zenoh_actor ROLE RUN_DIR`.

Each says `up` when it is ready; a line on stdin ends it, and asks for its result where it has one.
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
    patience = 0.3 if role == "shot" else 5.0  # there is no hub for that one to wait for
    client = create("zenoh", role, ZenohSettings(run_dir=Path(run_dir))).open(patience)
    globals()[role](client)


def say(text: object) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def talker(client: Transport) -> None:
    """Numbers its messages at 200 Hz; says how many."""
    _count_until_told(client, "talk", 0.005, retain=False)


def keeper(client: Transport) -> None:
    """Counts in five kept topics at 100 Hz; says how far it came."""
    _count_until_told(client, "kept/{}", 0.01, retain=True)


def _count_until_told(client: Transport, topic: str, pause: float, *, retain: bool) -> None:
    told, number = threading.Event(), 0
    threading.Thread(target=_wait_to_be, args=(told,), daemon=True).start()
    say("up")
    while not told.wait(pause):
        number += 1
        client.publish(topic.format(number % 5), b"%d" % number, qos=DELIVERED, retain=retain)
    say(number)
    sys.stdin.readline()
    client.close()


def _wait_to_be(told: threading.Event) -> None:
    sys.stdin.readline()
    told.set()


def shot(client: Transport) -> None:
    """Publishes once, right after it opened, and is gone."""
    client.publish("shot", b"x", qos=DELIVERED)
    client.close()
    say("up")


def pinger(client: Transport) -> None:
    """Publishes on the topic it is told, at once."""
    say("up")
    for topic in sys.stdin:
        client.publish(topic.strip(), b"x", qos=DELIVERED)
        say("")
    client.close()


def listener(client: Transport) -> None:
    """Says how many messages it has heard and the last one, whenever it is asked."""
    heard: list[Message] = []
    client.subscribe("#", heard.append)
    say("up")
    for _ in sys.stdin:
        say(f"{len(heard)} {heard[-1].payload.decode() if heard else ''}")
    client.close()


def killed(client: Transport) -> None:
    """Waits to be killed, with a will parked by its own hand in the name of `client`."""
    client.close()
    with_will = create("zenoh", "killed", client._settings, will=Message("will", b"dead", DELIVERED, True))  # type: ignore[attr-defined]
    with_will.open(5)
    say("up")
    sys.stdin.readline()


def returns(client: Transport) -> None:
    client.subscribe("#", lambda _: None)
    say("up")


def raises(client: Transport) -> None:
    returns(client)
    raise RuntimeError("nobody caught this")


def exits(client: Transport) -> None:
    returns(client)
    sys.exit(3)


def forks(client: Transport) -> None:
    """The child may neither use its parent's session nor open one."""
    say("up")
    child = os.fork()
    if child == 0:
        os._exit(_refusals(client))
    _, status = os.waitpid(child, 0)
    say(os.waitstatus_to_exitcode(status))
    client.close()


def _refusals(client: Transport) -> int:
    attempts = (
        lambda: client.publish("from/child", b""),
        lambda: client.subscribe("to/child", print),
        lambda: create("zenoh", "child", client._settings).open(1),  # type: ignore[attr-defined]
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

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pebble.transports import Message, QoS, create
from pebble.transports.zenoh import callbacks
from tests.support import until
from tests.transports.zenoh_net import HubProcess

#: Answers with more than the sockets hold: from its handler, or from a thread for which its handler waits meanwhile.
ANSWERING = """
import sys, threading
from pathlib import Path
from pebble.transports import QoS, ZenohSettings, create

def answer():
    for _ in range(int(sys.argv[2])):
        transport.publish("answer", bytes(int(sys.argv[3])), qos=QoS.DELIVERED)

def answer_alone():
    with lock:
        begun.set()
        answer()

def on_request(message):
    if message.payload == b"handler":
        answer()
    elif message.payload == b"thread":
        threading.Thread(target=answer_alone).start()
        begun.wait()
    elif message.payload == b"lock":
        lock.acquire()
        lock.release()

lock, begun = threading.Lock(), threading.Event()
with create("zenoh", "answering", ZenohSettings(run_dir=Path(sys.argv[1]))) as transport:
    transport.subscribe("request", on_request, direct=True)
    print(flush=True)
    sys.stdin.read()
"""
ANSWERS, ANSWER_BYTES = 3000, 1000


@contextmanager
def answering(hub: HubProcess) -> Iterator[None]:
    """A process that is ready to answer."""
    command = [sys.executable, "-c", ANSWERING, str(hub.settings.run_dir), str(ANSWERS), str(ANSWER_BYTES)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        yield
        process.stdin.close()


def size_to(received: list[int]) -> Callable[[Message], None]:
    """A handler that keeps no message: thousands of them would make Python's collector look at all that pytest has,
    which on a busy machine takes the 0.3 s after which a sender gives up (measured)."""
    return lambda message: received.append(len(message.payload))


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[HubProcess]:
    hub = HubProcess(tmp_path).start()
    yield hub
    hub.end()


@pytest.mark.parametrize("requests", [[b"handler"], [b"thread", b"lock"]], ids=lambda one: one[0].decode())
def test_a_handler_may_wait_for_what_is_published(hub: HubProcess, requests: list[bytes]) -> None:
    """Its thread may be the one that waits for the sockets: the guard has another one do that."""
    received: list[int] = []
    with create("zenoh", "asking", hub.settings) as transport, answering(hub):
        transport.subscribe("answer", size_to(received), direct=True)
        for number in range(1, 4):
            for request in requests:
                assert transport.publish("request", request, qos=QoS.DELIVERED)
            assert until(lambda enough=number * ANSWERS: len(received) >= enough), len(received)  # type: ignore[misc]
    assert len(received) == 3 * ANSWERS


def test_the_guard_rests_without_callbacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks, "_LOOK_S", 0.001)
    guard, calls = callbacks.Guard(), callbacks.Calls()
    guard.watch(calls)
    for _ in range(2):
        calls.begun += 1
        guard.wake()
        assert until(lambda: guard.helped > 0)  # it runs
        assert not guard.rests
        calls.ended += 1
        assert until(lambda: guard.rests)
        guard.helped = 0

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pebble.transports import Message, QoS, create
from pebble.transports.zenoh import thread_state
from tests.support import until
from tests.transports.zenoh_net import HubProcess

SESSIONS, MESSAGES = 4, 50
FORKED = """
import os, sys
from pathlib import Path
from pebble.transports import ZenohSettings, create
environment = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
import pebble.transports.zenoh.transport
os.environ.clear()
os.environ.update(environment)
settings = ZenohSettings(run_dir=Path(sys.argv[1]))
with create("zenoh", "one", settings), create("zenoh", "other", settings):
    print(*{(task / "comm").read_text().split("-")[0].strip() for task in Path("/proc/self/task").iterdir()})
"""


@pytest.mark.parametrize("most", [0, 1, thread_state.MOST])
def test_there_are_few_states_however_many_messages_and_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Beyond them everything works as well."""
    made, received, ensure = list[None](), list[Message](), thread_state._ensure
    monkeypatch.setattr(thread_state, "_ensure", lambda: (made.append(None), ensure()))
    monkeypatch.setattr(thread_state, "_numbers", itertools.count())
    monkeypatch.setattr(thread_state, "_remembered", threading.local())
    monkeypatch.setattr(thread_state, "MOST", most)
    hub = HubProcess(tmp_path).start()
    try:
        with create("zenoh", "sender", hub.settings) as sender:
            for session in range(1, SESSIONS + 1):
                with create("zenoh", "receiver", hub.settings) as receiver:
                    receiver.subscribe("a/b", received.append, direct=True)
                    assert until(
                        lambda enough=session * MESSAGES: (  # type: ignore[misc]
                            sender.publish("a/b", b"1", qos=QoS.DELIVERED) and len(received) >= enough
                        ),
                        10,
                    )
    finally:
        hub.end()
    assert min(most, 1) <= len(made) <= most


def test_a_service_with_an_environment_of_its_own_reads_on_one_runtime(tmp_path: Path) -> None:
    """The launcher imports the transport, forks, and sets the service's environment. Else `acc` and `net` wake `rx`."""
    command = [sys.executable, "-c", FORKED, str(tmp_path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=30)
    runtimes = set(done.stdout.split())
    assert "rx" in runtimes
    assert runtimes.isdisjoint({"acc", "net"})

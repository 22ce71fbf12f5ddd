"""A network process that does not answer in time is not used again."""

import os
import signal

import pytest

from pebble.bench.impair import network as module
from pebble.bench.impair.network import NamespaceNetwork
from pebble.errors import PebbleError
from pebble.rig import processes


@pytest.mark.usefixtures("namespaces_permitted")
def test_a_late_answer_is_not_taken_for_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    process = NamespaceNetwork()
    monkeypatch.setattr(module, "_ANSWER_S", 0.1)
    monkeypatch.setattr(processes, "_END_S", 0.1)
    os.kill(process.pid, signal.SIGSTOP)
    with pytest.raises(PebbleError, match="network did not answer"):
        process.traffic()
    with pytest.raises(PebbleError, match="network is closed"):
        process.traffic()
    process.close()

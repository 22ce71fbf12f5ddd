"""Behaviour of impaired networks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair.conditions import Condition, Shape
from pebble.extensions.lab.bench.impair.network import NamespaceNetwork
from pebble.extensions.lab.rig.processes import children
from tests.ext.lab.bench.impair.peers import ProbeConnection
from tests.support import ROOT, Child, gone, until

_OWNER = """
import time
from pebble.extensions.lab.bench.impair.network import NamespaceNetwork
network = NamespaceNetwork()
print("ready", flush=True)
time.sleep(60)
"""
_SLACK = 20.0  # a transfer may take so many times longer on a busy machine


def test_a_rate_limits_the_uplink_only_and_the_connection_stays(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        network.apply(Condition("1024k", Shape(kbit=1024)))
        must = 30_000 * 8 / 1_024_000
        assert must * 0.95 < talk.up(30_000) < must * _SLACK
        assert talk.down(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2
        network.apply(Condition("base-end"))
        assert talk.up(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2


def test_what_was_carried_is_counted_with_its_headers(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        before = network.bytes_up()
        talk.up(100_000)
        assert 100_000 + 66 * 69 <= network.bytes_up() - before < 125_000


@pytest.mark.usefixtures("namespaces_permitted")
def test_close_leaves_nothing_and_may_be_repeated() -> None:
    before = set(children(os.getpid()))
    network = NamespaceNetwork()
    (process,) = set(children(os.getpid())) - before
    network.close()
    network.close()
    assert gone(process)
    assert not (Path("/sys/class/net") / "wire").exists()
    with pytest.raises(PebbleError, match="No such file"):
        network.apply(Condition("late"))


@pytest.mark.usefixtures("namespaces_permitted")
def test_a_killed_owner_leaves_nothing() -> None:
    with Child([sys.executable, "-c", _OWNER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline().strip() == "ready"
        (process,) = children(owner.pid)
        owner.kill()
        assert until(lambda: gone(process))

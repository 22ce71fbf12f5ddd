"""Behaviour of impaired networks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.network import NamespaceNetwork
from pebble.errors import PebbleError
from pebble.rig.processes import children
from tests.bench.impair.peers import ProbeConnection
from tests.support import ROOT, Child, gone, until

_OWNER = """
import time
from pebble.bench.impair.network import NamespaceNetwork
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


def test_delay_and_back_to_none_on_one_connection(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        network.apply(Condition("far", Shape(delay_ms=40), Shape(delay_ms=20)))
        assert 0.06 <= min(talk.round_trips()) < 0.5
        network.apply(Condition("near"))
        assert min(talk.round_trips()) < 0.06


def test_loss_is_late_to_tcp_but_nothing_is_missing(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        network.apply(Condition("lossy", Shape(loss=0.1)))
        talk.up(200_000)
        assert network.traffic().dropped_up > 0


def test_what_was_carried_is_counted_with_its_headers(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        before = network.traffic()
        talk.up(100_000)
        after = network.traffic()
    assert 100_000 + 66 * 69 <= after.bytes_up - before.bytes_up < 125_000


@pytest.mark.usefixtures("namespaces_permitted")
def test_close_leaves_nothing_and_may_be_repeated() -> None:
    before = set(children(os.getpid()))
    network = NamespaceNetwork()
    (process,) = set(children(os.getpid())) - before
    network.close()
    network.close()
    assert gone(process)
    assert not (Path("/sys/class/net") / "wire").exists()
    with pytest.raises(PebbleError, match="closed"):
        network.apply(Condition("late"))


@pytest.mark.usefixtures("namespaces_permitted")
def test_a_killed_owner_leaves_nothing() -> None:
    with Child([sys.executable, "-c", _OWNER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline().strip() == "ready"
        (process,) = children(owner.pid)
        owner.kill()
        assert until(lambda: gone(process))

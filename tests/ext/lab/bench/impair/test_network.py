"""Impaired networks of namespaces, where the machine permits them."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.impair.conditions import Condition, Shape
from pebble.extensions.lab.bench.impair.network import NamespaceNetwork, why_no_namespaces
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
_SENT = 2000
_DATAGRAM = 142  # bytes, with the headers of Ethernet, IP and UDP
_BAND = range(50, 151)  # lost of 100 on average; five standard deviations


@pytest.fixture
def _permitted() -> None:
    """Skips without permission or programs, and fails for another reason; checked only when a test needs it."""
    if obstacle := why_no_namespaces():
        assert re.search("run it as root|not permitted|Permission denied|failed to execute", obstacle), obstacle
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.fixture
def network(_permitted: None) -> Iterator[NamespaceNetwork]:
    with closing(NamespaceNetwork("of a test")) as made:
        yield made


def test_a_rate_limits_the_uplink_only_and_the_connection_stays(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        network.apply(Condition("1024k", Shape(kbit=1024)))
        must = 30_000 * 8 / 1_024_000
        assert must * 0.95 < talk.up(30_000) < must * _SLACK
        assert talk.down(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2
        network.apply(Condition("base-end"))
        assert talk.up(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2


def test_packets_are_those_of_a_wire_and_counted_with_their_headers(network: NamespaceNetwork, tmp_path: Path) -> None:
    with ProbeConnection(network, tmp_path) as talk:
        before = network.bytes_up()
        talk.up(100_000)
        assert 100_000 + 66 * 69 <= network.bytes_up() - before < 125_000


def test_loss_drops_the_configured_share_of_packets(network: NamespaceNetwork, tmp_path: Path) -> None:
    def lost() -> int:
        counters = network.on_remote(["nft", "list", "chain", "ip", "impair", "arriving"])
        return sum(map(int, re.findall(r"packets (\d+)", subprocess.check_output(counters, text=True))))

    with ProbeConnection(network, tmp_path) as talk:
        before = network.bytes_up()
        network.apply(Condition("5%", Shape(loss=0.05)))
        talk.send_datagrams(_SENT)
        assert lost() in _BAND
        assert until(lambda: talk.received_datagrams() + lost() == _SENT, 30)
        assert network.bytes_up() - before >= _SENT * _DATAGRAM


def test_the_namespaces_have_no_other_connection(network: NamespaceNetwork) -> None:
    for command in (network.on_robot, network.on_remote):
        shown = subprocess.check_output(command(["cat", "/proc/net/dev"]), text=True)
        assert {line.split(":")[0].strip() for line in shown.splitlines()[2:]} == {"lo", "wire"}


@pytest.mark.usefixtures("_permitted")
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


@pytest.mark.usefixtures("_permitted")
def test_a_killed_owner_leaves_nothing() -> None:
    with Child([sys.executable, "-c", _OWNER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline().strip() == "ready"
        (process,) = children(owner.pid)
        owner.kill()
        assert until(lambda: gone(process))


@pytest.mark.usefixtures("_permitted")
def test_a_user_without_permission_gets_the_reason() -> None:
    forwarder = [sys.executable, "-m", "pebble.extensions.lab.bench.impair.network"]
    uid = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--", *forwarder]
    printed = json.loads(subprocess.run(uid, stdin=subprocess.DEVNULL, capture_output=True, check=False).stdout)
    assert "not permitted: run it as root" in printed["unavailable"]

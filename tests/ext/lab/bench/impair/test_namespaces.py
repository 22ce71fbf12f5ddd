"""Rate, loss and packet size of networks of namespaces."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from pebble.extensions.lab.bench.impair.conditions import Condition, Shape
from pebble.extensions.lab.bench.impair.network import NamespaceNetwork
from tests.ext.lab.bench.impair.peers import ProbeConnection, largest_packet
from tests.support import ROOT, until

pytestmark = pytest.mark.usefixtures("namespaces_permitted")

_SENT = 2000
_DATAGRAM = 142  # bytes, with the headers of Ethernet, IP and UDP
_BAND = range(50, 151)  # of 100 on average; five standard deviations


def lost(side: Callable[[Sequence[str]], list[str]]) -> int:
    """How many packets were lost on their way to this side."""
    listed = subprocess.check_output(side(["nft", "list", "chain", "ip", "impair", "arriving"]), text=True)
    return sum(map(int, re.findall(r"packets (\d+)", listed)))


def test_loss_drops_the_configured_share_of_packets(tmp_path: Path) -> None:
    with closing(NamespaceNetwork()) as network, ProbeConnection(network, tmp_path) as talk:
        before = network.bytes_up()
        network.apply(Condition("5%", Shape(loss=0.05)))
        talk.send_datagrams(_SENT)
        assert lost(network.on_remote) in _BAND
        assert until(lambda: talk.received_datagrams() + lost(network.on_remote) == _SENT, 30)
        assert network.bytes_up() - before >= _SENT * _DATAGRAM


@pytest.mark.parametrize("kbit", [None, 4000])
def test_no_packet_is_larger_than_on_a_wire(kbit: float | None, tmp_path: Path) -> None:
    with (
        closing(NamespaceNetwork()) as network,
        ProbeConnection(network, tmp_path) as talk,
        largest_packet(network, tmp_path) as largest,
    ):
        network.apply(Condition("bulk", Shape(kbit=kbit)))
        talk.up(200_000)
        assert until(lambda: largest() >= 1514)
        assert largest() == 1514


def test_the_namespaces_have_no_other_connection() -> None:
    with closing(NamespaceNetwork()) as network:
        for command in (network.on_robot, network.on_remote):
            shown = subprocess.check_output(command(["cat", "/proc/net/dev"]), text=True)
            devices = {line.split(":")[0].strip() for line in shown.splitlines()[2:]}
            assert devices == {"lo", "wire"}


def test_a_user_without_permission_gets_the_reason() -> None:
    forwarder = [sys.executable, "-m", "pebble.extensions.lab.bench.impair.network"]
    uid = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--", *forwarder]
    printed = json.loads(subprocess.run(uid, stdin=subprocess.DEVNULL, capture_output=True, check=False).stdout)
    assert "not permitted: run it as root" in printed["unavailable"]


def test_a_port_is_found_without_a_loopback_device() -> None:
    asked = [sys.executable, "-c", "from pebble.extensions.lab.rig.processes import free_port; print(free_port())"]
    assert int(subprocess.check_output(["unshare", "--net", *asked], cwd=ROOT)) > 0

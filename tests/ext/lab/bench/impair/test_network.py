"""Impaired networks of namespaces, where the machine permits them."""

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from pebble.extensions.lab.bench.impair.network import (
    REMOTE_HOST,
    ROBOT_HOST,
    Condition,
    NamespaceNetwork,
    why_no_namespaces,
)
from pebble.extensions.lab.rig.processes import children
from tests.support import ROOT, Child, gone, until

_OWNER = """
import time
from pebble.extensions.lab.bench.impair.network import NamespaceNetwork
network = NamespaceNetwork()
print("ready", flush=True)
time.sleep(60)
"""
_FETCH = """
import sys, time, urllib.request
began = time.monotonic()
urllib.request.urlopen(sys.argv[1]).read()
print(time.monotonic() - began)
"""
_SEND = "import socket; s = socket.socket(2, 2); [s.sendto(b'x' * 100, ('{}', 9)) for _ in range(2000)]"
_BAND = range(50, 151)  # lost of 100 on average; five standard deviations
_RATE = Condition("1024k", kbit=1024)


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


@contextmanager
def served(network: NamespaceNetwork, folder: Path) -> Iterator[None]:
    """Files of 30,000 and 1,000,000 bytes on both sides."""
    for size in (30_000, 1_000_000):
        (folder / str(size)).write_bytes(bytes(size))
    serve = [sys.executable, "-m", "http.server", "--directory", str(folder), "8000"]
    with Child(network.on_robot(serve), stderr=-3) as robot, Child(network.on_remote(serve), stderr=-3) as remote:
        try:
            assert until(
                lambda: all("1F40" in Path(f"/proc/{side.pid}/net/tcp").read_text() for side in (robot, remote))
            )
            yield
        finally:
            robot.kill()
            remote.kill()


def fetching(side: Callable[[Sequence[str]], list[str]], host: str, size: int) -> Child:
    return Child(side([sys.executable, "-c", _FETCH, f"http://{host}:8000/{size}"]), stdout=-1, text=True)


def seconds(fetch: Child) -> float:
    return float(fetch.communicate(timeout=60)[0])


def test_a_rate_limits_the_uplink_only_and_a_connection_stays_when_it_ends(
    network: NamespaceNetwork, tmp_path: Path
) -> None:
    full_s = 1_000_000 * 8 / 1_024_000
    with served(network, tmp_path):
        network.apply(_RATE)
        assert seconds(fetching(network.on_remote, ROBOT_HOST, 30_000)) > 30_000 * 8 / 1_024_000 * 0.95
        assert seconds(fetching(network.on_robot, REMOTE_HOST, 1_000_000)) < full_s / 2
        fetch = fetching(network.on_remote, ROBOT_HOST, 1_000_000)
        time.sleep(0.5)
        network.apply(Condition("base-end"))
        assert seconds(fetch) < full_s / 2


def test_loss_drops_the_configured_share_of_packets(network: NamespaceNetwork) -> None:
    network.apply(Condition("5%", loss=0.05))
    subprocess.run(network.on_robot([sys.executable, "-c", _SEND.format(REMOTE_HOST)]), check=True)
    counters = network.on_remote(["nft", "list", "chain", "ip", "impair", "arriving"])
    printed = subprocess.check_output(counters, text=True)
    assert sum(map(int, re.findall(r"packets (\d+)", printed))) in _BAND


@pytest.mark.usefixtures("_permitted")
def test_a_killed_owner_leaves_nothing() -> None:
    with Child([sys.executable, "-c", _OWNER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline().strip() == "ready"
        (process,) = children(owner.pid)
        owner.kill()
        assert until(lambda: gone(process))

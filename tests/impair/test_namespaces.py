"""What the kernel does on a link of namespaces: rate, loss, and packets no larger than a wire's."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.impair import namespaces
from pebble.impair.conditions import Condition, Shape
from pebble.impair.link import open_link
from tests.impair.peers import Talk, largest_packet
from tests.support import ROOT, until

pytestmark = pytest.mark.usefixtures("namespaces_permitted")

_SENT = 2000
_BAND = range(50, 151)  # of 100 on average; five standard deviations


@pytest.mark.parametrize("delay_ms", [0, 1], ids=["wire", "timed"])
def test_loss_loses_as_many_packets_as_it_says(delay_ms: int, tmp_path: Path) -> None:
    with open_link("namespaces") as link, Talk(link, tmp_path) as talk:
        before = link.carried()
        link.apply(Condition("5%", Shape(loss=0.05, delay_ms=delay_ms)))
        talk.send_datagrams(_SENT)
        assert until(lambda: talk.heard_datagrams() + link.carried().dropped_up >= _SENT)
        carried = link.carried()
        dropped = carried.dropped_up - before.dropped_up
        assert dropped in _BAND
        assert talk.heard_datagrams() == _SENT - dropped
        assert carried.packets_up - before.packets_up >= _SENT


def test_loss_of_the_downlink_is_counted_there(tmp_path: Path) -> None:
    with open_link("namespaces") as link, Talk(link, tmp_path) as talk:
        link.apply(Condition("down", Shape(), Shape(loss=0.2)))
        talk.down(100_000)
        assert link.carried().dropped_down > 0
        assert link.carried().dropped_up == 0


def test_a_full_queue_drops_and_the_count_survives_the_next_condition(tmp_path: Path) -> None:
    with open_link("namespaces") as link, Talk(link, tmp_path) as talk:
        link.apply(Condition("64k", Shape(kbit=64)))
        talk.send_datagrams(400)
        dropped = link.carried().dropped_up
        assert dropped > 50
        for kbit in (128, None, 256):
            link.apply(Condition("next", Shape(kbit=kbit)))
            assert link.carried().dropped_up >= dropped
        assert link.carried().dropped_up <= 400


@pytest.mark.parametrize("kbit", [None, 4000])
def test_no_packet_is_larger_than_on_a_wire(kbit: float | None, tmp_path: Path) -> None:
    with open_link("namespaces") as link, Talk(link, tmp_path) as talk, largest_packet(link, tmp_path) as largest:
        link.apply(Condition("bulk", Shape(kbit=kbit)))
        talk.up(200_000)
        assert until(lambda: largest() >= 1514)
        assert largest() == 1514


def test_the_sides_cannot_see_the_world() -> None:
    with open_link("namespaces") as link:
        for command in (link.on_robot, link.on_remote):
            shown = subprocess.check_output(command(["cat", "/proc/net/dev"]), text=True)
            devices = {line.split(":")[0].strip() for line in shown.splitlines()[2:]}
            assert devices == {"lo", "wire", "timed"}


def test_a_missing_program_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(namespaces, "_SBIN", "/nowhere")
    monkeypatch.setenv("PATH", "/nowhere")
    assert namespaces.obstacle.__wrapped__() == "there is no program ip: apt-get install iproute2"


def test_what_is_permitted_and_does_not_work_is_no_reason_for_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(namespaces, "_TABLE", "nonsense")
    with pytest.raises(PebbleError, match="namespaces do not work here: nft -f -: "):
        namespaces.obstacle.__wrapped__()


def test_a_user_who_may_not_is_told_so() -> None:
    forwarder = [sys.executable, "-m", "pebble.impair.forwarder"]
    nobody = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--", *forwarder]
    said = json.loads(subprocess.run(nobody, stdin=subprocess.DEVNULL, capture_output=True, check=False).stdout)
    assert "not permitted: run it as root" in said["unavailable"]


def test_a_port_is_found_without_a_loopback_device() -> None:
    asked = [sys.executable, "-c", "from pebble.demo.broker import free_port; print(free_port())"]
    assert int(subprocess.check_output(["unshare", "--net", *asked], cwd=ROOT)) > 0

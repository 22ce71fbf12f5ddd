"""What holds for a link of either kind."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.bench.usage import children
from pebble.errors import PebbleError
from pebble.impair.conditions import Condition, Shape, chosen
from pebble.impair.link import Link, open_link
from tests.impair.peers import Talk
from tests.support import ROOT, Child, gone, until

_OWNER = """
import sys, time
from pebble.impair.link import open_link
link = open_link(sys.argv[1])
print(link.kind, flush=True)
time.sleep(60)
"""
_SLACK = 20.0  # how many times longer than it must a transfer may take on a busy machine


def test_a_rate_limits_the_uplink_only_and_the_connection_stays(link: Link, tmp_path: Path) -> None:
    with Talk(link, tmp_path) as talk:
        link.apply(Condition("1024k", Shape(kbit=1024)))
        must = 30_000 * 8 / 1_024_000
        assert must * 0.95 < talk.up(30_000) < must * _SLACK
        assert talk.down(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2
        link.apply(Condition("base-end"))
        assert talk.up(1_000_000) < 1_000_000 * 8 / 1_024_000 / 2


def test_both_ways(link: Link, tmp_path: Path) -> None:
    with Talk(link, tmp_path) as talk:
        link.apply(Condition("1024k", Shape(kbit=1024), Shape(kbit=1024)))
        must = 30_000 * 8 / 1_024_000
        assert must * 0.95 < talk.down(30_000) < must * _SLACK


def test_delay_and_back_to_none_on_one_connection(link: Link, tmp_path: Path) -> None:
    with Talk(link, tmp_path) as talk:
        link.apply(Condition("far", Shape(delay_ms=40), Shape(delay_ms=20)))
        assert 0.06 <= min(talk.round_trips()) < 0.5
        link.apply(Condition("near"))
        assert min(talk.round_trips()) < 0.06


def test_loss_is_late_to_tcp_but_nothing_is_missing(link: Link, tmp_path: Path) -> None:
    with Talk(link, tmp_path) as talk:
        link.apply(Condition("lossy", Shape(loss=0.1)))
        talk.up(200_000)
        carried = link.carried()
        assert carried.packets_up > 130
        assert carried.dropped_up > 0
        assert carried.dropped_down == 0


def test_what_was_carried_is_counted_with_its_headers(link: Link, tmp_path: Path) -> None:
    with Talk(link, tmp_path) as talk:
        before = link.carried()
        talk.up(100_000)
        talk.down(50_000)
        after = link.carried()
    assert 100_000 + 66 * 69 <= after.bytes_up - before.bytes_up < 125_000
    assert 50_000 + 66 * 34 <= after.bytes_down - before.bytes_down < 75_000
    assert after.packets_up - before.packets_up >= 69


def test_conditions_of_every_kind_can_follow_each_other(link: Link) -> None:
    for condition in chosen(["64k", "5%", "64k+5%", "base-end", "starlink", "wifi-power-save"], both_ways=True):
        link.apply(condition)


def test_links_know_nothing_of_each_other(kind: str, tmp_path: Path) -> None:
    with (
        open_link(kind) as one,
        open_link(kind) as other,
        Talk(one, tmp_path) as first,
        Talk(other, tmp_path) as second,
    ):
        one.apply(Condition("far", Shape(delay_ms=100)))
        assert min(first.round_trips(3)) >= 0.1
        assert min(second.round_trips()) < 0.1


def test_close_leaves_nothing_and_may_be_said_again(kind: str) -> None:
    before = set(children(os.getpid()))
    link = open_link(kind)
    (helper,) = set(children(os.getpid())) - before
    link.close()
    link.close()
    assert gone(helper)
    assert not (Path("/sys/class/net") / "wire").exists()
    with pytest.raises(PebbleError, match="closed"):
        link.apply(Condition("late"))


def test_a_killed_owner_leaves_nothing(kind: str) -> None:
    with Child([sys.executable, "-c", _OWNER, kind], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout.readline().strip() == kind
        (helper,) = children(owner.pid)
        owner.kill()
        assert until(lambda: gone(helper))


def test_there_are_two_kinds_of_links() -> None:
    with pytest.raises(PebbleError, match="no kind of link 'wire': choose from auto, namespaces, proxy"):
        open_link("wire")

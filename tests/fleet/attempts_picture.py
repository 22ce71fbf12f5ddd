"""Makes docs/fleet-attempts.png: what each role got through at real brokers and at a real Zenoh hub.

Run ``python -m tests.fleet.attempts_picture`` (3 minutes). It ends with 1 if any attempt ended otherwise than the roles
say.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pebble.config.security import SecurityLevel
from pebble.fleet.attempts import ROWS, Row, may, topics
from pebble.fleet.broker_client import BrokerClient
from pebble.fleet.roles import Account, rules
from pebble.transports.base import Message, QoS
from tests.fleet.brokers import FleetBroker
from tests.fleet.test_attempts import ACCOUNTS, EYE, GOOB, LEVELS, seen
from tests.fleet.test_zenoh import Hall, play
from tests.support import ROOT, until

PICTURE = ROOT / "docs" / "fleet-attempts.png"
COLUMNS = {
    "vera": "viewer", "otto": "driver", "mia": "maintainer", "sam": "safety", "admin": "admin", "page-1": "page",
    "goob": "the robot", "fred": "another robot", "gate": "gateway", "lan": "its neighbour",
}  # fmt: skip
TRIED = tuple(row for row in ROWS if not row.metrics[0].startswith("$"))  # accounts are changed at mosquitto only
WAYS = ("mosquitto, plugin", "mosquitto, acl_file", "Zenoh hub")
_QUIET_S = 0.3  # what a will or a hub still brings
Passed = dict[tuple[str, str], set[str]]  # topics, by account and row


def expected(level: SecurityLevel, way: str) -> Passed:
    """By the one table. A hub takes no command as a will, and retains none but a robot's own, never below a name."""
    found = {}
    for name in COLUMNS:
        account = Account(roles=("admin",)) if name == "admin" else ACCOUNTS[name]
        held = rules(name, account, level, at_hub=way == WAYS[2])
        for row in TRIED:
            allowed = {one for one in topics(row, GOOB, name, level, "dora") if may(held, "write", one)}
            left = row.will or (row.retained and (name != "goob" or level == "named"))
            found[name, row.what] = set() if way == WAYS[2] and left else allowed
    return found


def at_broker(broker: FleetBroker, eye: BrokerClient, name: str, row: Row) -> set[str]:
    """The topics of a row that came through."""
    level = broker.fleet.level
    wanted = topics(row, GOOB, name, level, "dora")
    for topic in wanted if row.will else ():
        will = Message(topic, name.encode(), qos=QoS.DELIVERED)
        BrokerClient(broker.place, name, broker.passwords[name], will=will).cut()
        eye.listen(_QUIET_S)
    with broker.login(name) as client:
        for topic in () if row.will else wanted:
            client.publish(topic, name.encode(), retain=row.retained)
        client.flush()
    return {topic for topic, payload in seen(eye) if payload == name.encode()} & set(wanted)


def at_hub(hall: Hall, name: str, row: Row) -> set[str]:
    wanted = topics(row, GOOB, name, hall.fleet.level, "dora")
    hall.received.clear()
    if row.will:
        for topic in wanted:
            with hall.account(name, will=topic):
                pass  # killed
        time.sleep(_QUIET_S)
        return hall.of(name) & set(wanted)
    with hall.account(name, topics=wanted, retain=row.retained) as client:
        play(client)
        until(lambda: set(wanted) <= hall.of(name), _QUIET_S)
        left = hall.retained() if row.retained else hall.of(name)
    for topic in wanted if row.retained else ():
        hall.eye.publish(topic, b"", qos=QoS.DELIVERED, retain=True)
    return left & set(wanted)


@contextmanager
def opened(way: str, level: SecurityLevel, folder: Path) -> Iterator[Callable[[str, Row], set[str]]]:
    assert level != "open"
    if way == WAYS[2]:
        with Hall(folder, level).running() as hall:
            yield lambda name, row: at_hub(hall, name, row)
        return
    accounts = ACCOUNTS | {"eye": EYE}
    fleet = FleetBroker(folder, accounts, level=level, rules="plugin" if way == WAYS[0] else "files")
    with fleet as broker, broker.login("eye") as eye:
        eye.subscribe(["+/+/+/incoming/#", "+/+/+/outgoing/#"])
        yield lambda name, row: at_broker(broker, eye, name, row)


def tried(way: str, level: SecurityLevel) -> Passed:
    """All that came through."""
    with tempfile.TemporaryDirectory(prefix="pbl") as folder, opened(way, level, Path(folder) / "hall") as attempt:
        return {(name, row.what): attempt(name, row) for name in COLUMNS for row in TRIED}


def draw(results: dict[SecurityLevel, dict[str, tuple[Passed, Passed]]], wrong: int) -> None:
    """One square for each way, side by side: filled where it came through, crossed where that was not expected."""
    from matplotlib import pyplot as plt
    from matplotlib.patches import Rectangle

    figure, panels = plt.subplots(1, len(results), figsize=(13, 8), sharey=True, layout="constrained")
    colours = ("#2f6f8f", "#5b9bb5", "#d08a2e")
    for axes, (level, ways) in zip(panels, results.items(), strict=True):
        for x, name in enumerate(COLUMNS):
            for y, row in enumerate(TRIED):
                for part, (want, got) in enumerate(ways.values()):
                    passed = got[name, row.what]
                    face = colours[part] if passed else "#eef0f2"  # also if a part of the topics did
                    axes.add_patch(Rectangle((x + 0.06 + part * 0.3, y + 0.12), 0.27, 0.76, facecolor=face))
                    if passed != want[name, row.what]:
                        axes.plot([x + 0.06 + part * 0.3, x + 0.33 + part * 0.3], [y + 0.12, y + 0.88], color="red")
        axes.set(xlim=(0, len(COLUMNS)), ylim=(len(TRIED), 0), title=f"level {level}")
        axes.set_xticks([x + 0.5 for x in range(len(COLUMNS))], list(COLUMNS.values()), rotation=35, ha="right")
        axes.set_yticks([y + 0.5 for y in range(len(TRIED))], [row.what for row in TRIED])
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
    marks = [Rectangle((0, 0), 1, 1, facecolor=colour) for colour in colours]
    marks.append(Rectangle((0, 0), 1, 1, facecolor="#eef0f2"))
    figure.legend(marks, [f"through at {way}" for way in WAYS] + ["refused"], loc="outside lower center", ncols=4)
    count = sum(len(got) for ways in results.values() for _, got in ways.values())
    figure.suptitle(f"{count} kinds of attempts at real brokers and a real hub, {wrong} otherwise than the roles say")
    figure.savefig(PICTURE, dpi=90)


def main() -> int:
    results: dict[SecurityLevel, dict[str, tuple[Passed, Passed]]] = {}
    for level in LEVELS:
        results[level] = {}
        for way in WAYS:
            results[level][way] = (expected(level, way), tried(way, level))
            print(f"{level}, {way}: {sum(map(bool, results[level][way][1].values()))} came through", flush=True)
    wrong = [
        f"{level}, {way}: {name} {'may' if got[name, what] else 'may not'} {what}"
        for level, ways in results.items()
        for way, (want, got) in ways.items()
        for name, what in got
        if got[name, what] != want[name, what]
    ]
    print(*wrong, f"{len(wrong)} otherwise than the roles say", sep="\n")
    draw(results, len(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

"""What a robot needs of a broker, as a table: each probe, its promises (docs/transports.md), their cost."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from pebble.check_result import CheckResult, State
from pebble.doctor.broker import endings, fail, messages, retention, strangers
from pebble.doctor.broker.peer import Bench, RefusedError


@dataclass(frozen=True)
class Probe:
    """``costs``: what it means for a robot and its operators where a broker lacks it."""

    name: str
    promises: tuple[str, ...]
    costs: str
    run: Callable[[Bench], CheckResult]

    def finding(self, bench: Bench) -> CheckResult:
        bench.begin(re.sub(r"\W+", "-", self.name).strip("-"))
        try:
            found = self.run(bench)
        except RefusedError as error:
            found = fail(f"a connection was refused: {error}", "let an account have ten connections at once")
        return replace(found, what=self.name)


RIGHTS = Probe("rights", (), "nothing else can be tried", messages.rights)
PROBES = (
    RIGHTS,
    Probe(
        "QoS 1",
        ("T3", "T20"),
        "events and answers may be lost on the way; stops are repeated by their senders",
        messages.acknowledged,
    ),
    Probe("1,000 messages", ("T3",), "states and answers are lost or out of order under load", messages.burst),
    Probe(
        "a receiver that is behind",
        ("T3",),
        "a robot behind a slow link misses flags, requests and answers",
        messages.queue,
    ),
    Probe("filters", ("T1",), "pages and tools miss robots, or see those of others", messages.filters),
    Probe(
        "names of topics", ("T2",), "a robot with such a name is not heard, or loses its connection", messages.topics
    ),
    Probe("payloads", ("T15",), "pictures of that size do not arrive", messages.payloads),
    Probe(
        "small messages",
        (),
        "boards and programs that confirm late are driven late; our own confirm at once",
        messages.delay,
    ),
    Probe("answers to pings", ("T19",), "a robot cannot tell how old a command is", messages.pings),
    Probe(
        "overlapping filters",
        ("T11",),
        "a program that does not merge its filters gets commands twice; ours do",
        messages.overlaps,
    ),
    Probe(
        "retained messages",
        ("T5", "T7"),
        "who connects later sees no state until it changes; a flag that is switched while the robot is away is lost",
        retention.by_name,
    ),
    Probe(
        "retained, to + and #",
        ("T5",),
        "programs that do not ask by name do not see a robot at rest; ours ask",
        retention.by_wildcard,
    ),
    Probe(
        "retained, before an answer to a ping",
        ("T5",),
        "a robot that comes back may send states once more; a flag may come twice",
        retention.before_pong,
    ),
    Probe(
        "removal",
        ("T6",),
        "what a robot took back, such as a sensor that is gone, is shown for ever",
        retention.removal,
    ),
    Probe("newest last", ("T8",), "other programs show an old value; ours drop it", retention.order),
    Probe(
        "bridge mode",
        ("T7", "T16"),
        "own messages come back and are filtered by comparison; no mirror",
        messages.as_published,
    ),
    Probe(
        "wills",
        ("T10",),
        "a robot that lost its power is shown as online until its heartbeat is overdue",
        endings.last_wills,
    ),
    Probe("no will after a goodbye", ("T10",), "a robot that ends in order goes offline twice", endings.goodbye),
    Probe(
        "same client again",
        ("T12",),
        "a robot that is back waits until its old connection is forgotten",
        endings.takeover,
    ),
    Probe("nothing from an outage", ("T4",), "a robot that is back is moved by commands of long ago", endings.outage),
    Probe("clients without a name", (), "strangers see the robots, or drive them", strangers.unnamed),
    Probe(
        "refused subscriptions",
        ("T21",),
        "a robot that may not read its commands seems to be ready, and does not move",
        messages.refusals,
    ),
    Probe("accounts", (), "a program with an error, or a stolen robot, lets anybody in", strangers.administers),
    Probe(
        "will of a silent client",
        ("T10",),
        "a robot out of radio range is shown as online until its heartbeat is overdue",
        endings.will_of_silent,
    ),
    Probe(
        "retained, after a restart",
        ("T9",),
        "running robots send their states again within 2 s; those of robots that are off, and flags, are lost",
        retention.restarted,
    ),
)


def run(bench: Bench) -> Iterator[tuple[Probe, CheckResult]]:
    """Make one probe after the other; without rights none but the first."""
    for probe in PROBES:
        found = probe.finding(bench)
        yield probe, found
        if probe is RIGHTS:
            if found.state is State.FAILED:
                return
            endings.fall_silent(bench)

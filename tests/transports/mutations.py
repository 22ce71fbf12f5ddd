"""Deliberate bugs in the MQTT connection, each with the tests that must find it.

``python -m tests.transports.mutations`` puts each into a copy of the tree; words choose some of them. One is found if a
test of its fails.
"""

# ruff: noqa: T201  (a program)

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from tests.support import ROOT

_FOLDERS = ("pebble", "transports", "services", "simulation", "firmware", "bench", "rig", "configs", "tests")
_MQTT, _CONNECTION = "test_mqtt.py", "test_mqtt_connection.py"


class Mutation(NamedTuple):
    """``old`` occurs once below transports/mqtt; ``tests``: a file and words for -k."""

    bug: str
    old: str
    new: str
    file: str
    words: str


MUTATIONS = [
    Mutation(
        "what lay in the socket counts as fresh",
        "self.since, self.checked_at, self._counted = self.checked_at, now, size",
        "self.since, self.checked_at, self._counted = now, now, size",
        "test_mqtt_read_age.py",
        "after_a_stop or piled_up",
    ),
    Mutation(
        "the socket counts as empty after the process has slept",
        "- began <= wait + OVERSLEPT_S:",
        "- began <= 1e9:",
        _CONNECTION,
        "while_it_waits",
    ),
    Mutation(
        "what waited at the broker counts as fresh",
        "        if waited > 0:\n",
        "        if waited > 1e9:\n",
        _MQTT,
        "waited_at_the_broker",
    ),
    Mutation(
        "no ping follows a time without reading",
        "        if since != self._stalled_since:",
        "        if False:",
        _CONNECTION,
        "ping_follows_at_once",
    ),
    Mutation(
        "a ping with every read after a time without reading",
        "        if since != self._stalled_since:",
        "        for _ in range(50):",
        _CONNECTION,
        "time_in_which_nothing_was_read",
    ),
    Mutation(
        "silence is not noticed",
        "if now - incoming.answered_at > incoming.silence_s:",
        "if now - incoming.answered_at > 1e9:",
        _CONNECTION,
        "is_silent or came_in_a_silence",
    ),
    Mutation(
        "pings are sent only in a silence",
        "if now >= self.pings.due_at:",
        "if now >= self.pings.due_at and now - incoming.answered_at > 0.4:",
        _CONNECTION,
        "while_other_answers_come",
    ),
    Mutation(
        "one late answer is a silence",
        "return max(self._silence_s, 4 * self._in_flight.round_trip_s)",
        "return self._silence_s / 4",
        _CONNECTION,
        "is_silent",
    ),
    Mutation(
        "retained messages do not show that the broker lives",
        "            age.has_retained = True\n",
        "            pass\n",
        _CONNECTION,
        "signs_of_life",
    ),
    Mutation(
        "pieces of a long message do not show that the broker lives",
        "if age.has_retained or (size and self._packets == first):",
        "if age.has_retained:",
        _CONNECTION,
        "signs_of_life",
    ),
    Mutation(
        "the time in which retained messages are handled counts as silence",
        "            incoming.age.note_handled()\n",
        "            incoming.age.has_retained = False\n",
        _CONNECTION,
        "handled_is_no_silence",
    ),
    Mutation(
        "a lost connection sends what its socket still holds",
        "sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)",
        "pass",
        _CONNECTION,
        "discarded_connection",
    ),
    Mutation(
        "messages are acknowledged before they are handled",
        "            messages, incoming.messages = incoming.messages, []\n",
        "            client.acknowledge()\n            messages, incoming.messages = incoming.messages, []\n",
        _CONNECTION,
        "acknowledged_when_it_was_handled",
    ),
    Mutation(
        "a subscription is confirmed before its retained messages are delivered",
        "        try:\n            if messages:\n",
        "        self._in_flight.complete()\n        try:\n            if messages:\n",
        _CONNECTION,
        "acknowledgement_is_complete",
    ),
    Mutation(
        "any number of messages may be unacknowledged",
        "self._in_flight.unacked >= UNACKED_LIMIT and",
        "self._in_flight.unacked >= 10**9 and",
        _MQTT,
        "unacknowledged_messages_are_bounded",
    ),
    Mutation(
        "stops have no room of their own",
        "return beyond >= UNACKED_RESERVE or not self._owner.is_stop(message.topic)",
        "return True",
        _MQTT,
        "unacknowledged_messages_are_bounded",
    ),
    Mutation(
        "no ping follows a message that may be at fault",
        "if (doubtful := self.pings.doubtful) and message.topic in doubtful:",
        "if (doubtful := self.pings.doubtful) and not doubtful:",
        _CONNECTION,
        "may_be_at_fault",
    ),
    Mutation(
        "a broker that hangs up on a message is taken for a broken link",
        "            return self._in_flight.first_written(clock.since_boot())",
        "            return None",
        _MQTT,
        "is_set_aside or hangs_up_costs_that_topic",
    ),
    Mutation(
        "a refused subscription counts as granted",
        "(filter_, code >= reasons.FAILURE) for filter_, code in answers)",
        "(filter_, False) for filter_, code in answers)",
        _MQTT,
        "refused_subscription or merged_filter",
    ),
    Mutation(
        "what the broker lacks is sent all the same",
        "            message = self.limits.fit(message)\n",
        "            pass\n",
        "test_mqtt_broker_limits.py",
        "messages_pass_both_ways",
    ),
    Mutation(
        "more is in flight than the broker takes",
        "        if self._left <= 0:",
        "        if self._left <= -1000:",
        "test_mqtt_client.py",
        "no_more_is_in_flight",
    ),
    Mutation(
        "a ping's answer confirms what was sent after it",
        "if entry.ping and entry.ping <= self._pong_number]",
        "if entry.ping and entry.ping <= self._pong_number + 1]",
        "test_mqtt_outgoing.py",
        "answered_ping_proves",
    ),
    Mutation(
        "older messages follow one that made them stale",
        '                    self._counters.add("dropped", self._backlog.supersede(message))',
        "                    pass",
        _CONNECTION,
        "stale",
    ),
    Mutation(
        "a retained message is skipped although an older one of the batch may change that",
        "        if self.messages:\n            return False",
        "        if False:\n            return False",
        _CONNECTION,
        "skip",
    ),
    Mutation(
        "nothing says that another client has our client id",
        "if id_ is not None and accepted and self._taken_over:",
        "if False:",
        "test_client_ids.py",
        "two_with_one_id",
    ),
]


def found(mutation: Mutation, folder: Path) -> bool:
    """Whether one of its tests fails in ``folder``, a copy of the tree."""
    files = [path for path in (folder / "transports/mqtt").glob("*.py") if mutation.old in path.read_text()]
    assert len(files) == 1, f"{mutation.bug}: {len(files)} files have {mutation.old!r}"
    text = files[0].read_text()
    assert text.count(mutation.old) == 1, mutation.bug
    files[0].write_text(text.replace(mutation.old, mutation.new))
    try:
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not thorough"]
        command += [f"tests/transports/{mutation.file}", "-k", mutation.words]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    finally:
        files[0].write_text(text)
    assert done.returncode in (0, 1), f"{mutation.bug}: {done.stdout}{done.stderr}"
    return done.returncode == 1


def main(words: list[str]) -> int:
    chosen = [one for one in MUTATIONS if all(re.search(word, one.bug) for word in words)]
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(ROOT / "pyproject.toml", folder)
        for one in _FOLDERS:
            shutil.copytree(ROOT / one, folder / one, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        for mutation in chosen:
            is_found = found(mutation, folder)
            missed += not is_found
            print(f"{'found    ' if is_found else 'NOT FOUND'} {mutation.bug}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} found")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

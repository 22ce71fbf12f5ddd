"""A helper that does not answer in time is not asked again."""

import os
import signal

import pytest

from pebble.bench import frames_process
from pebble.errors import PebbleError
from pebble.impair import helper as module
from pebble.impair.helper import Helper


def test_a_late_answer_is_not_taken_for_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    helper = Helper("link", "pebble.impair.proxy_process")
    monkeypatch.setattr(module, "_ANSWER_S", 0.1)
    monkeypatch.setattr(frames_process, "_END_S", 0.1)
    os.kill(helper.pid, signal.SIGSTOP)
    with pytest.raises(PebbleError, match="link said nothing"):
        helper.ask("count")
    with pytest.raises(PebbleError, match="link is closed"):
        helper.ask("count")
    helper.close()

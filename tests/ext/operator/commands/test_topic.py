"""``pebble topic`` with real brokers and hubs."""

from __future__ import annotations

import itertools
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands.command_line import Run, running
from tests.support import Broker
from tests.transports.zenoh_net import HubProcess

_numbers = itertools.count(1)


@pytest.fixture(scope="module")
def local_transports(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A broker and a hub, by kind of transport, as URLs."""
    run_dir = tmp_path_factory.mktemp("z")
    hub = HubProcess(run_dir).start()
    yield {"mqtt": f"mqtt://127.0.0.1:{broker.port}", "zenoh": f"zenoh:{run_dir}"}
    hub.end()


@pytest.fixture(params=["mqtt", "zenoh"])
def at(request: pytest.FixtureRequest, local_transports: dict[str, str]) -> tuple[str, str, str]:
    """Options that lead there, with a robot of the test's own."""
    return "--url", local_transports[request.param], f"--robot=r{next(_numbers)}"


def test_what_is_published_is_echoed_and_its_rate_measured_on_either_transport(
    at: tuple[str, str, str], run: Run
) -> None:
    assert run("topic", "pub", "charging-level", '{"value": 7.4}', *at) == 0
    with running("topic", "pub", "drive-values", '{"x": 0.5}', "--rate", "40", *at) as pub:
        assert run("topic", "echo", "drive-values", "--count", "3", "--seconds", "60", *at) == 0, run.err
        assert run.out.splitlines()[1::2] == ['{"x": 0.5}'] * 3
        assert "incoming/drive-values  10 B  qos 1" in run.out
        assert run("topic", "hz", "drive-values", "--seconds", "2", *at) == 0
        assert " kbit/s  min " in run.out
        assert run("topic", "hz", "charging-level", "--seconds", "1.5", *at) == 1, "what is retained does not count"
        assert set(run.out.splitlines()) == {"no new messages"}
        pub.send_signal(signal.SIGINT)
        assert (pub.communicate(timeout=30), pub.returncode) == (("", ""), 130)


def test_retained_topics_are_listed_with_their_synonym_and_echoed_raw(at: tuple[str, str, str], run: Run) -> None:
    assert run("topic", "pub", "flags/mqtt-video", "true", *at) == 0
    assert run("topic", "pub", "heartbeat", '{"t": 1710969600123}', *at) == 0
    assert (run("topic", "list", "--seconds", "1", *at), run.err) == (0, "")
    rows = {line.split()[0]: line.split()[1:] for line in run.out.splitlines()}
    assert rows["incoming/flags/mqtt-video"] == ["yes", "4", "B", "?", "flag"]
    assert rows["outgoing/heartbeat"][0] == "yes"
    assert rows["outgoing/heartbeat"][-3:] == ["state", "(like", "online)"]
    assert run("topic", "echo", "online", "--raw", "--count", "1", "--seconds", "30", *at) == 0
    assert run.out == '{"t": 1710969600123}\n'


def test_a_password_comes_from_a_file_or_the_environment(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "geheim"], check=True, capture_output=True)
    passwords.chmod(0o644)
    broker = Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    (tmp_path / "right").write_text("geheim\n")
    url = f"mqtt://ann@127.0.0.1:{broker.port}"
    pub = ("topic", "pub", "status", "{}", "--robot", "goob", "--url", url)
    try:
        assert run(*pub, "--password-file", tmp_path / "right") == 0
        assert (run(*pub), run.err.count("\n")) == (1, 1)
        assert "cannot connect" in run.err
        monkeypatch.setenv("PEBBLE_PASSWORD", "geheim")
        assert run(*pub) == 0
    finally:
        broker.stop()

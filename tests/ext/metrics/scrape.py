"""`pebble exporter` as a process, and a strict parser of what it serves."""

from __future__ import annotations

import re
import select
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tests.commands.command_line import running
from tests.support import WAIT_S, Broker

TYPE = re.compile(r"# TYPE (pebble_[a-z_]+) (gauge|counter)")
SAMPLE = re.compile(r'(pebble_[a-z_]+)\{((?:[a-z]+="(?:[^"\\\n]|\\[\\"n])*"(?:,(?!})|(?=})))*)\} (-?[0-9.e+-]+)')
Samples = dict[str, float]


def parse(text: str) -> Samples:
    """Return samples by metric and labels, as they are written."""
    samples: Samples = {}
    types: dict[str, str] = {}
    assert text.endswith("\n")
    for line in text[:-1].split("\n"):
        if (kind := TYPE.fullmatch(line)) is not None:
            assert kind[1] not in types
            assert (kind[2] == "counter") is kind[1].endswith("_total")
            types[kind[1]] = kind[2]
            continue
        sample = SAMPLE.fullmatch(line)
        assert sample is not None, line
        assert sample[1] == list(types)[-1]  # the samples of a metric stand together
        assert len({*re.findall(r'([a-z]+)="', sample[2])} - {"robot"}) <= 1
        name = f"{sample[1]}{{{sample[2]}}}"
        assert name not in samples
        samples[name] = float(sample[3])
    return samples


@contextmanager
def exporter(broker: Broker, *options: str) -> Iterator[str]:
    """Give the address of an exporter."""
    with running("exporter", "--url", f"mqtt://127.0.0.1:{broker.port}", "--port", "0", *options) as process:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], 30)[0], "nothing was printed"
        line = process.stdout.readline()
        assert "; Ctrl-C ends it" in line
        yield line.split(" at ")[1].split(";")[0]


def get(address: str, token: str = "") -> str:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=WAIT_S) as answer:
        text: str = answer.read().decode()
        return text


def shows(address: str, **expected: float | None) -> Callable[[], bool]:
    """Return a condition: the metrics of goob have these values; None: they are absent."""

    def is_so() -> bool:
        samples = {name.partition("{")[0]: value for name, value in parse(get(address)).items()}
        return all(samples.get(f"pebble_{name}") == value for name, value in expected.items())

    return is_so

"""A picture of a robot; without a remote broker it is of its own machine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from tests.commands.command_line import Run, config_file
from tests.ext.av.media_rig import HEIGHT, WIDTH, Filming
from tests.support import Broker


@pytest.fixture
def config(tmp_path: Path) -> Iterator[Path]:
    broker = Broker(tmp_path)
    # pytest's own folder may be too long for a socket
    with tempfile.TemporaryDirectory(prefix="pebble-") as run_dir, Filming(Path(run_dir)):
        yield config_file(
            tmp_path,
            local_mqtt={"host": "127.0.0.1", "port": broker.port},
            transport={"kind": "mqtt", "run_dir": run_dir},
        )
    broker.stop()


def test_a_picture_is_of_the_local_camera(run: Run, config: Path) -> None:
    file = config.with_name("view.png")
    file.symlink_to(config)  # another user may have made it
    assert run("watch", config, "--picture", file) == 0, run.err
    assert run.out == f"{file}: {WIDTH}×{HEIGHT}\n"
    assert run.err == f"pebble: {config} names no remote broker: this machine's camera\n"
    assert not file.is_symlink()
    picture = cv2.imread(str(file))
    assert picture is not None
    assert picture[5, 5].tolist() == [10, 20, 30]


def test_a_picture_that_cannot_be_written_is_one_line(run: Run, config: Path) -> None:
    name = "picture.xyz"
    assert run("watch", config, "--picture", config.parent / name) == 1
    assert name in run.err.splitlines()[-1]

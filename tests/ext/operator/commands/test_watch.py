"""A picture of a robot; without a remote broker it is of its own machine."""

from __future__ import annotations

import tempfile
import threading
from contextlib import closing
from pathlib import Path

import cv2

from tests.commands.command_line import Run, config_file
from tests.ext.av.media_rig import HEIGHT, WIDTH, Filming
from tests.ext.foxglove.live import client
from tests.ext.page.media.robots import PictureRobot
from tests.support import Broker, beside, until


def test_a_picture_is_of_the_local_camera(run: Run, broker: Broker, tmp_path: Path) -> None:
    local, file = {"host": "127.0.0.1", "port": broker.port}, tmp_path / "view.png"
    # pytest's own folder may be too long for a socket
    with tempfile.TemporaryDirectory(prefix="pebble-") as run_dir, Filming(Path(run_dir)):
        config = config_file(tmp_path, local_mqtt=local, transport={"kind": "mqtt", "run_dir": run_dir})
        file.symlink_to(config)  # another user may have made it
        assert run("watch", config, "--picture", tmp_path / "picture.xyz") == 1
        assert "picture.xyz" in run.err.splitlines()[-1]
        assert run("watch", config, "--picture", file) == 0, run.err
    assert run.out == f"{file}: {WIDTH}×{HEIGHT}\n"
    assert run.err == f"pebble: {config} names no remote broker: this machine's camera\n"
    assert not file.is_symlink()
    picture = cv2.imread(str(file))
    assert picture is not None
    assert picture[5, 5].tolist() == [10, 20, 30]


def test_with_an_address_it_is_the_first_that_comes_and_no_more_are_wanted(
    run: Run, broker: Broker, tmp_path: Path
) -> None:
    robot, file = PictureRobot(transport=client(broker)), tmp_path / "view.png"
    robot.mute = True  # what it loses is asked for again

    def hear() -> None:
        assert until(lambda: [request["enabled"] for request in robot.requests] == [True, True])
        robot.mute = False

    with closing(robot), beside(hear, threading.Event()):
        url = f"mqtt://127.0.0.1:{broker.port}"
        assert run("watch", "goob", "--url", url, "-e", "pbvd", "--picture", file) == 0, run.err
        assert run.out == f"{file}: 160×120\n"
        assert until(lambda: robot.encodings == ["pbvd", None])

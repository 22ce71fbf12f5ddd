"""Worlds: mistakes in their files, what a camera sees, their pages of poses, their program, and their steps."""

from __future__ import annotations

import ctypes
import hashlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import serial

import pebble.extensions.lab.simulation.world
from pebble import Robot
from pebble.contract.identity import LEVEL_RULE
from pebble.errors import ConfigError, DeviceError
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, Pose
from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.lockstep import LockstepWorld
from pebble.extensions.lab.simulation.world.pose_page import PosePage, PoseReader, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose, Sample, Track
from pebble.extensions.lab.simulation.world.program import imu_port_path, port_path, trace_path
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from pebble.extensions.lab.simulation.world.world_file import parse_world
from tests.ext.lab.simulation.world.worlds import CLEAR, projected, seen, tags_in, world_of
from tests.support import WAIT_S, Child, until

GOOB = {"x": 0.0, "y": 0.0}


def problems(**keys: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_world({"robots": {"goob": GOOB}} | keys)
    return caught.value.problems


def test_all_mistakes_are_reported_at_once_with_their_places() -> None:
    wrong = {
        "familie": 1,
        "camera": {"hfov": 60, "noise": -1},
        "tags": [{"id": 3, "x": "a", "y": 0.0}, {"x": 1, "y": 1}],
        "robots": {"goob": {"x": 0.0, "kind": "tank"}},
    }
    assert sorted(problems(**wrong)) == sorted(
        [
            'familie: unknown key, did you mean "family"?',
            'camera.hfov: unknown key, did you mean "hfov_deg"?',
            "camera.noise: must be a number from 0 to 100, not -1",
            "tags[0].x: must be a number from -100 to 100, not text",
            "tags[1].id: is missing, write a whole number from 0 to 2319",
            'robots.goob.kind: must be "goob" or "fred"',
            "robots.goob.y: is missing, write a number from -100 to 100",
        ]
    )


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"robots": {}}, "robots: must be 1 to 32 robots, not 0"),
        ({"robots": {"goob": GOOB, "fred": {"x": 0.1, "y": 0.0}}},
         "robots.fred: stands 0.10 m from goob, must be 0.2 m or more"),
        ({"robots": {"goob": GOOB | {"tag": 99}}},
         "robots.goob.tag: must be below 35, the number of tags in APRILTAG_25h9, not 99"),
        ({"drawings": [{"x": 1, "y": 0, "z": 0.3, "width_m": 1, "height_m": 1, "shapes": []}]},
         "drawings[0]: needs shapes of three points or more, each x and y"),
        ({"walls": [{"x1": 0.05, "y1": 1, "x2": 0.05, "y2": -1}]},
         "robots.goob: stands 0.05 m from a wall, its radius is 0.1"),
        ({"room": {"x_min": 1, "x_max": 0, "y_min": 0, "y_max": 1}},
         "room.x_min: must be below x_max, which is 0, not 1"),
        ({"robots": {"a/b": GOOB}}, f"robots.a/b: the name must be {LEVEL_RULE}, at most 64 bytes"),
    ],
)  # fmt: skip
def test_values_that_contradict_each_other_are_refused(keys: dict[str, Any], problem: str) -> None:
    assert problems(**keys) == [problem]


WALL = {"x1": 1.0, "y1": 1.0, "x2": 1.0, "y2": -1.0}
TAG = {"id": 13, "x": 2.0, "y": 0.0, "yaw_deg": 180.0}
CAMERAS = [
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 0.35),
    (-0.5, -1.0, 0.5),
    (3.2, 0.3, math.pi),  # of the other tag
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_tag_is_where_the_pinhole_model_puts_it(camera: tuple[float, float, float]) -> None:
    world = world_of(tags=[TAG, {**TAG, "id": 4, "x": 2.02, "yaw_deg": 0.0}])
    ((number, corners),) = tags_in(seen(world, size=(1280, 720), goob=camera)).items()
    assert np.abs(corners - projected(world, number, camera, (1280, 720))).max() < 1.0


NEAR = {**TAG, "y": 0.5, "size_m": 0.1}
AWAY = {"x1": 0.5, "y1": 0.15, "x2": 6.0, "y2": -0.5}
FRED = {"goob": {"x": 0, "y": 0}, "fred": {"x": 1.5, "y": 0, "tag": 2}}
THREE = {name: {"x": x, "y": 0.0, "tag": tag} for name, x, tag in (("goob", 0.0, 1), ("fred", 1.0, 2), ("ben", 2.0, 3))}
BEHIND = {"robots": THREE, "tags": [{**TAG, "x": 3.0, "size_m": 0.1, "z": 0.1}]}
#: Keys of a world, where robots stand, and the tags that goob sees.
SCENES: list[tuple[dict[str, Any], dict[str, Any], set[int]]] = [
    ({"tags": [TAG]}, {}, {13}),
    ({"tags": [TAG], "walls": [WALL]}, {}, set()),
    ({"tags": [NEAR], "walls": [AWAY]}, {}, set()),  # nearer than the middle of the wall
    ({"tags": [{**TAG, "z": 0.5}], "walls": [{**WALL, "height_m": 0.2}]}, {}, {13}),
    ({"tags": [{**TAG, "x": 1.0, "y": 0.3}], "walls": [WALL]}, {}, {13}),  # on the wall
    ({"tags": [{**TAG, "x": 1.0}], "walls": [WALL]}, {"goob": (2.0, 0.0, math.pi)}, set()),  # from behind
    ({"robots": FRED, "walls": [WALL]}, {"fred": (1.3, 0.0, 0.2)}, set()),
    ({"robots": FRED, "walls": [WALL]}, {"fred": (0.8, 0.0, 0.2)}, {2}),
    (BEHIND, {"fred": (1.2, 0, 0), "ben": (0.6, 0, 0)}, {3}),
    (BEHIND, {"fred": (0.8, 0.3, 0), "ben": (1.2, -0.4, 0)}, {2, 3, 13}),
]


@pytest.mark.parametrize(("keys", "poses", "tags"), SCENES)
def test_walls_and_robots_hide_what_is_behind_them(keys: dict[str, Any], poses: dict[str, Any], tags: set[int]) -> None:
    assert set(tags_in(seen(world_of(**keys), **poses))) == tags


@pytest.mark.parametrize(
    ("fault", "least", "most"),
    [({"noise": 8.0}, 6, 7), ({"blur": 3.0}, 2, 4), ({"jpeg_quality": 10}, 3, 5), ({}, -1, 0)],
)
def test_a_fault_of_the_camera_changes_each_pixel_by_so_much(fault: dict[str, float], least: int, most: int) -> None:
    clear, faulty = (seen(world_of(tags=[TAG], camera={**CLEAR, **keys})) for keys in ({}, fault))
    assert least < np.abs(faulty.astype(np.int16) - clear).mean() <= most


BUSY = """
import sys
from pathlib import Path
from pebble.extensions.lab.simulation.world.pose_page import PosePage
from pebble.extensions.lab.simulation.world.poses import RobotPose
page = PosePage(Path(sys.argv[1]), ["goob", "fred"])
ns = 0
while True:
    ns += 1
    page.write(ns, [RobotPose(ns, -ns, 3 * ns), RobotPose(5 * ns, ns, -ns)])
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pages" / "page"


@pytest.fixture
def busy_writer(path: Path) -> Iterator[Child]:
    """A process that writes as fast as it can, until it is killed; sample ``ns`` can be checked."""
    with Child([sys.executable, "-c", BUSY, str(path)]) as child:
        try:
            assert until(lambda: path.exists() and len(PoseReader(path).tracks()) == 2, 60)
            yield child
        finally:
            child.kill()


def test_no_sample_is_torn_under_a_busy_writer_and_a_killed_one_is_replaced(busy_writer: Child, path: Path) -> None:
    reader, newest = PoseReader(path), 0
    for _ in range(500):
        tracks = reader.tracks()
        for name, (a, b, c) in (("goob", (1, -1, 3)), ("fred", (5, 1, -1))):
            assert all(pose == (a * ns, b * ns, c * ns) for ns, pose in tracks[name].samples)
        assert tracks["goob"].newest.ns >= newest
        newest = tracks["goob"].newest.ns
    busy_writer.kill()
    busy_writer.wait(WAIT_S)
    page = PosePage(path, ["goob"])
    assert reader.tracks() == {}, "its world was started again"
    assert PoseReader(path).tracks() == {}, "nothing of the killed program is left"
    page.close()


def test_a_world_has_one_program_whose_end_a_reader_notices(path: Path) -> None:
    page = PosePage(path, ["goob"])
    with pytest.raises(DeviceError, match="this world runs already"):
        PosePage(path, ["goob"])
    page.write(1, [RobotPose(0, 0, 0)])
    reader = PoseReader(path)
    assert list(reader.tracks()) == ["goob"]
    page.close()
    assert reader.tracks() == {}
    with pytest.raises(FileNotFoundError):
        PoseReader(path)


def test_what_is_no_page_and_a_folder_that_others_may_write_are_refused(path: Path) -> None:
    path.parent.mkdir(mode=0o700)
    path.write_bytes(b"x" * 1000)
    with pytest.raises(msgspec.DecodeError):
        PoseReader(path)
    path.parent.chmod(0o777)
    with pytest.raises(DeviceError, match="is not a folder that only you may write"):
        PosePage(path, ["goob"])


TRACK = Track([Sample(100, RobotPose(0, 0, 3.0)), Sample(200, RobotPose(1, -2, -3.0)), Sample(300, RobotPose(1, 0, 0))])


@pytest.mark.parametrize(
    ("ns", "pose"), [(0, (0, 0, 3.0)), (150, (0.5, -1.0, math.pi)), (200, (1, -2, -3.0)), (999, (1, 0, 0))]
)
def test_a_pose_is_a_samples_or_interpolated_the_short_way_round(ns: int, pose: tuple[float, float, float]) -> None:
    assert tuple(TRACK.at(ns)) == pytest.approx(pose)


ROOM = Path(pebble.extensions.lab.simulation.world.__file__).with_name("room.json")


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return Path(shutil.copy(ROOM, tmp_path / "room.json"))


def command(room: Path, *options: str) -> list[str]:
    world = [sys.executable, "-m", "pebble.cli", "sim", "world", str(room)]
    return [*world, "--folder", str(room.parent / "f"), *options]


@contextmanager
def running(room: Path, *options: str) -> Iterator[Child]:
    began = time.monotonic_ns()
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Child(command(room, *options), text=True, **pipes) as child:
        try:
            assert until(lambda: any(track.newest.ns > began for track in tracks(room).values()))
            yield child
        finally:
            child.terminate()
            child.communicate(timeout=WAIT_S)


def tracks(room: Path) -> dict[str, Track]:
    """Empty while the world does not run."""
    try:
        return PoseReader(page_path(room)).tracks()
    except OSError:
        return {}


def poses(room: Path) -> dict[str, RobotPose]:
    return {name: track.newest.pose for name, track in tracks(room).items()}


def test_the_usual_folder_of_a_world_ends_with_it(room: Path) -> None:
    usual = room.parent / f"pebble-world-{room.stem}"
    world = [sys.executable, "-m", "pebble.cli", "sim", "world", str(room)]
    with Child(world, env=os.environ | {"TMPDIR": str(room.parent)}) as child:
        assert until(lambda: port_path(usual, "fred").exists())
        child.terminate()
        child.wait(WAIT_S)
    assert not usual.exists()


def test_a_signal_ends_a_world_whose_file_is_a_pipe_that_sends_nothing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with Child(command(tmp_path / "pipe")) as child, (tmp_path / "pipe").open("wb"):  # it waits for the other end
        child.terminate()
        assert child.wait(WAIT_S) == -signal.SIGTERM


def test_a_world_is_driven_controlled_and_ended_by_its_standard_input(room: Path) -> None:
    described = json.loads(room.read_text())
    described["robots"]["goob"]["imu"] = True
    room.write_text(json.dumps(described))
    folder = room.parent / "f"
    goob, imu = port_path(folder, "goob"), imu_port_path(folder, "goob")
    traces = room.parent / "new" / "traces"
    with running(room, "--trace", str(traces), "--control") as world:
        start = poses(room)
        assert start["goob"] == pytest.approx((-0.8, 0.4, -0.5236), abs=1e-4)
        with serial.Serial(str(imu), timeout=30) as line:
            assert line.read(100)
        world.stdin.write("goob place 1 -0.5 90\nfred unplug\ngoob fly\ntank reset\ngoob place 1 2\n")
        world.stdin.flush()
        assert until(lambda: poses(room)["goob"] == pytest.approx((1.0, -0.5, 1.5708), abs=1e-4))
        assert until(lambda: not port_path(folder, "fred").is_symlink())
        for complaint in ("known commands: unplug", "begin with a robot (goob, fred)", "place needs three numbers"):
            assert complaint in world.stderr.readline()
        with serial.Serial(str(goob)) as port:
            port.write(b"M 0.5 0.5\n")
            assert until(lambda: poses(room)["goob"].y > -0.4)
            assert poses(room)["goob"].x == pytest.approx(1.0, abs=0.01)
        assert poses(room)["fred"] == start["fred"]
        world.stdin.close()
        assert world.wait(30) == 0, "the end of standard input ends it"
        world.stdin, printed = None, world.stdout.read()
    assert "M 0.5 0.5" in [entry.line for entry in read_trace(trace_path(traces, "goob"))]
    assert poses(room) == {}, "nothing is left of a world that has ended"
    assert f'"serial_mcu_bridge": {{"serial":{{"port":"{port_path(folder, "fred")}"}}' in printed
    assert f'"instances":{{"imu":{{"protocol":"pebble_serial_v1","serial":{{"port":"{imu}"' in printed
    assert all(f'"device":"{room}#{name}"' in printed for name in ("goob", "fred"))


def test_a_world_that_was_killed_starts_again(room: Path) -> None:
    with running(room) as world:
        world.kill()
        world.wait(30)
    with running(room) as world:
        assert poses(room)["goob"].x == pytest.approx(-0.8)
        # a signal ends it whichever thread receives it: libraries start threads when they are imported
        tasks = sorted(int(path.name) for path in Path(f"/proc/{world.pid}/task").iterdir())
        tasks.remove(world.pid)
        assert ctypes.CDLL(None).tgkill(world.pid, tasks[0], signal.SIGTERM) == 0
        assert world.wait(30) == 0


# -- a world whose time the test advances, repeatable to the last bit


WORLD: dict[str, Any] = {
    "tags": [{"id": 13, "x": 3.0, "y": 0.0, "yaw_deg": 180.0}],
    "robots": {"goob": {"x": 0.0, "y": 0.0}, "fred": {"kind": "fred", "x": 1.0, "y": 0.6, "tag": 2}},
    "camera": {"latency_ms": 70.0, "motion_blur_ms": 20.0},
}


def history(seconds: float) -> str:
    simulated, digest = LockstepWorld(parse_world(WORLD)), hashlib.sha256()
    goob, fred = simulated.robots.values()
    fred.write(b"M 0.5 0.1\n")
    while simulated.now() < seconds:
        simulated.step()
        if (picture := goob.picture()) is not None:  # turn towards the tag and go to it
            corners = tags_in(picture.pixels).get(13, np.full((1, 2), 500.0))
            goob.drive(x=(corners[:, 0].mean() - 319.5) / 1000, z=0.4)
            digest.update(picture.pixels)
        digest.update(goob.read() + fred.read() + repr((goob.pose, fred.pose)).encode())
    return digest.hexdigest()


@pytest.mark.computing
def test_two_runs_are_the_same_to_the_last_bit() -> None:
    assert history(0.5) == history(0.5)


def ahead(robot: Robot) -> None:
    while robot.drive(z=0.5):
        robot.sleep(0.1)


@pytest.mark.computing
def test_a_script_moves_its_robot_and_leaves_it_at_rest(tmp_path: Path) -> None:
    (tmp_path / "world.json").write_text(json.dumps(WORLD))
    robot = SimulatedRobot(tmp_path / "world.json")
    robot.run(ahead, seconds=4.0)
    assert robot.distance_to(tag=13) == pytest.approx(3.0 - 4.0 * 0.19, abs=0.03)
    before = robot.body.pose
    robot.world.run(1.0)
    assert robot.body.pose.x == pytest.approx(before.x, abs=0.03)


# -- robots have bodies


TOUCH_M = 0.9  # x of a robot of radius 0.1 at the wall


def driven(seconds: float, left: float, right: float, world: LockstepWorld | None = None, **keys: Any) -> LockstepWorld:
    """Drive goob's wheels."""
    world = world or LockstepWorld(world_of(**keys))
    end = world.now() + seconds
    while world.now() < end:
        world.robots["goob"].write(b"M %.3f %.3f\n" % (left, right))
        world.run(0.1)
    return world


@pytest.mark.computing
@pytest.mark.parametrize("heading_deg", [0.0, -40.0])
def test_a_wall_stops_a_robot_where_its_body_touches(heading_deg: float) -> None:
    world = driven(4.0, 1, 1, walls=[WALL], robots={"goob": {"x": 0.0, "y": 0.0, "heading_deg": heading_deg}})
    goob = world.robots["goob"]
    assert goob.pose.x == pytest.approx(TOUCH_M, abs=1e-4)
    assert goob.pose.y == pytest.approx(TOUCH_M * math.tan(math.radians(heading_deg)), abs=1e-3), "it does not slide"
    assert goob.pose.heading == pytest.approx(math.radians(heading_deg))
    before = goob.motion.left_mm
    driven(1.0, 1, 1, world)
    assert goob.motion.left_mm - before == pytest.approx(FULL_SPEED_MM_S, rel=0.05), "the wheels slip and count on"
    driven(1.0, -1, -1, world)
    assert goob.pose.x < TOUCH_M - 0.2, "it drives away"


@pytest.mark.computing
def test_robots_stop_each_other_and_neither_is_pushed() -> None:
    world = LockstepWorld(parse_world({"robots": {"goob": {"x": 0.0, "y": 0.0}, "fred": {"x": 1.0, "y": 0.0}}}))
    fred = world.robots["fred"].pose
    driven(4.0, 1, 1, world)
    assert world.robots["fred"].pose == fred
    assert world.robots["goob"].pose.x == pytest.approx(0.8, abs=1e-4)
    world.robots["fred"].motion.place(Pose(0.0, 1000.0, 0.0))
    assert driven(1.0, 1, 1, world).robots["goob"].pose.x > 0.9, "it leaves no obstacle behind"

"""What a script of the original's shape needs, and what it is told where that is missing."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.services.autonomy_manager.catalogue import Catalogue
from pebble.services.autonomy_manager.describe import DescribeError
from pebble.services.autonomy_manager.local_media import LocalMedia
from pebble.services.autonomy_manager.needs import DETECT_MARKERS, GSTREAMER, SHMSRC, Needs, needs_of
from pebble.services.autonomy_manager.pythons import Pythons, probe
from pebble.services.autonomy_manager.script import Script, StartError, plan

READS_PICTURES = """
import argparse, cv2
import paho.mqtt.client as mqtt
parser = argparse.ArgumentParser()
parser.add_argument("--video-shm", default="")
def pictures(path):
    return cv2.VideoCapture(f"shmsrc socket-path={path} ! video/x-raw,format=BGR ! appsink", cv2.CAP_GSTREAMER)
"""
PAHO = "import paho.mqtt.client"


@pytest.mark.parametrize(
    ("files", "needs"),
    [
        ({"run.py": "import json, os.path"}, {}),
        ({"run.py": READS_PICTURES}, {"modules": ("cv2", "paho"), "features": (GSTREAMER, SHMSRC), "pictures": True}),
        ({"run.py": "import shape\nRUN = 'follow.py'", "shape.py": PAHO, "follow.py": "import cv2"},
         {"modules": ("paho", "cv2")}),
        ({"run.py": "import cv2\nfound = cv2.aruco.detectMarkers"},
         {"modules": ("cv2",), "features": (DETECT_MARKERS,)}),
        ({"run.py": "import cv2\ntry:\n    d = cv2.aruco.ArucoDetector\nexcept AttributeError:\n"
          "    d = cv2.aruco.detectMarkers"}, {"modules": ("cv2",)}),
        ({"run.py": "try:\n    import cv2\nexcept ImportError:\n    cv2 = None"}, {}),
        ({"run.py": "def show():\n    import matplotlib"}, {}),
        ({"run.py": "PIPE = 'shmsrc socket-path=x ! audio/x-raw,format=S16LE'"},
         {"features": (SHMSRC,), "sound": True}),
        ({"run.py": "MAGIC = b'PBODRAW1'"}, {"hall": True}),
        ({"run.py": "OPTIONS = ('--calibration', 'camera_calibration.yaml')"}, {"calibration": True}),
        ({"run.py": "NOTE = 'camera_calibration.yaml'"}, {}),
        ({"run.py": "import sys\nsys.path.insert(0, '..')\nimport control.common"},
         {"moves_path": True, "original": True}),
        ({"run.py": "import control.common", "../../control/common.py": PAHO}, {"modules": ("paho",)}),
        ({"run.py": "import sys\nsys.path.insert(0, '/opt/pebble')\nimport control.common"}, {"moves_path": True}),
        ({"run.py": "print 'of another Python'"}, {}),
    ],
)  # fmt: skip
def test_needs_are_read_from_the_text(tmp_path: Path, files: dict[str, str], needs: dict[str, Any]) -> None:
    folder = tmp_path / "autonomy" / "script"
    for name, text in files.items():
        (folder / name).resolve().parent.mkdir(parents=True, exist_ok=True)
        (folder / name).resolve().write_text(text)
    found = needs_of(folder / "run.py")
    assert (Needs(**needs), len(found.files) >= 1) == (
        Needs(**{field: getattr(found, field) for field in Needs.__struct_fields__ if field != "files"}),
        True,
    )


class Machine:
    """Answers for interpreters: what each of them has."""

    def __init__(self, folder: Path, **has: str) -> None:
        self.has = {sys.executable: "paho cv2", **{str(folder / name): things for name, things in has.items()}}
        for name in has:
            (folder / name).touch()
        self.asked = 0

    def __call__(
        self, python: str, things: Sequence[str], _folder: Path, _variables: Mapping[str, str]
    ) -> tuple[list[str], list[str]]:
        self.asked += 1
        if python not in self.has:
            raise DescribeError("it cannot be asked")
        return [thing for thing in things if thing not in self.has[python]], [str(Path(python).parent)]


PICTURES = Needs(modules=("cv2", "paho"), features=(GSTREAMER,))
SOCKET = Needs(modules=("cv2",), features=(GSTREAMER, SHMSRC))
ALL = f"cv2 paho {GSTREAMER} {DETECT_MARKERS} {SHMSRC}"


@pytest.mark.parametrize(
    ("system", "given", "needs", "chosen", "problem"),
    [
        (ALL, None, Needs(modules=("paho",)), "own", ""),
        (ALL, None, PICTURES, "python3", ""),
        ("paho", None, PICTURES, "python3",
         f"/python3 lacks cv2, {GSTREAMER}: apt install python3-opencv"),
        ("", None, PICTURES, "python3",
         f"/python3 lacks cv2, paho, {GSTREAMER}: apt install python3-opencv python3-paho-mqtt"),
        (ALL, "mine", PICTURES, "mine",
         "/mine lacks OpenCV with GStreamer: set scripts.walk.python to {}/python3"),
        ("paho", "mine", PICTURES, "mine",
         "/mine lacks OpenCV with GStreamer: apt install python3-opencv, and set scripts.walk.python to {}/python3"),
        (f"cv2 {GSTREAMER}", None, SOCKET, "python3", f"/python3 lacks {SHMSRC}: apt install gstreamer1.0-plugins-bad"),
        ("", None, SOCKET, "python3",
         f"/python3 lacks cv2, {GSTREAMER}, {SHMSRC}: apt install python3-opencv gstreamer1.0-plugins-bad"),
        (ALL, None, Needs(modules=("pupil_apriltags",)), "python3", "/python3 lacks pupil_apriltags"),
        (ALL, None, Needs(modules=("beside",), moves_path=True), "own", ""),
        (ALL, "unknown", PICTURES, "unknown", ""),
        (ALL, None, Needs(original=True), "own", "it imports `control` of the original's repository, and is no longer"),
    ],
)  # fmt: skip
def test_the_python_that_has_what_a_script_needs(
    tmp_path: Path, system: str, given: str | None, needs: Needs, chosen: str, problem: str
) -> None:
    machine = Machine(tmp_path, python3=system, mine="cv2 paho")
    pythons = Pythons(machine, (tmp_path / "missing", tmp_path / "python3"))
    path = None if given is None else str(tmp_path / given)
    for _ in range(2):
        python, why = pythons.choose("walk", path, needs, tmp_path, {})
    assert python == (sys.executable if chosen == "own" else str(tmp_path / chosen))
    assert why.removeprefix(str(tmp_path)).startswith(problem.format(tmp_path))
    assert bool(why) == bool(problem)
    assert machine.asked <= 2, "an answer is remembered"
    (tmp_path / "installed").touch()
    machine.has[str(tmp_path / "python3")] = machine.has[str(tmp_path / "mine")] = f"{ALL} pupil_apriltags"
    assert needs.original or pythons.choose("walk", path, needs, tmp_path, {})[1] == "", "installing helps at once"


def test_a_python_is_asked_without_running_the_script(tmp_path: Path) -> None:
    (tmp_path / "helper.py").write_text("raise SystemExit('it was run')")
    missing, path = probe(sys.executable, ["msgspec", "nump", "helper", GSTREAMER], tmp_path, {})
    assert missing == ["nump", GSTREAMER], "the wheel's OpenCV has no GStreamer"
    assert any("site-packages" in place for place in path)


def config(folder: Path, root: str, video: Mapping[str, Any] | None = None, **scripts: Any) -> Config:
    services = {
        "autonomy_manager": {"autonomy_root": root, "scripts": scripts},
        "av_daemon": {"enabled": True, "video": {"width": 640, "height": 480, **(video or {})}},
    }
    return parse({"robot": {"id": "rover"}, "services": services}, folder=folder, env={})


def scripts(settings: Config, system: Path, has: str) -> dict[str, Script]:
    machine = Machine(system.parent, **{system.name: has})
    found: list[dict[str, Script]] = []
    Catalogue(settings, pythons=Pythons(machine, (system,)), asks=False).scan(found.append)
    return found[-1]


def write(folder: Path, name: str, text: str) -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / "run.py").write_text(text)


def test_a_copy_that_cannot_run_does_not_hide_ours(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("apriltag-locations", "wheel-odometry", "mine"):
        write(tmp_path / "autonomy", name, "import cv3")
    write(tmp_path / "autonomy", "apriltag-follow", "import paho")
    found = scripts(config(tmp_path, "autonomy", **{"wheel-odometry": {"entrypoint": "run.py"}}), tmp_path / "py", ALL)
    why = f"{tmp_path}/py lacks cv3"
    assert {name: (script.ours, script.broken, script.instead_of) for name, script in found.items()} == {
        "apriltag-follow": (False, "", ""),
        "apriltag-locations": (True, "", why),
        "apriltag-odom-follow": (True, "", ""),
        "follow": (True, "", ""),
        "mine": (False, why, ""),
        "wheel-odometry": (True, "", why),
    }
    assert "Pebble's own wheel-odometry is offered instead" in caplog.text
    alone = scripts(config(tmp_path, str(tmp_path / "autonomy")), tmp_path / "py", ALL)
    assert alone["wheel-odometry"].broken == (
        f"{why}; Pebble's own wheel-odometry does the same: write a relative autonomy_root, and it is offered"
    )


@pytest.mark.parametrize(
    ("wanted", "problem"),
    [
        ({}, None),
        ({"width": 0, "height": 0}, None),
        ({"width": 1280, "height": 720}, "it asks for 1280x720, the camera sends 640x480: tags would be misplaced"),
    ],
)
def test_pictures_of_another_size_than_the_cameras_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: dict[str, Any], problem: str | None
) -> None:
    monkeypatch.setattr(LocalMedia, "lacks", lambda *_: "")
    write(tmp_path, "apriltag-locations", READS_PICTURES)
    args = [{"key": key, "type": "int", "arg": f"--{key}"} for key in wanted]
    settings = config(tmp_path, str(tmp_path), **{"apriltag-locations": {"args": args}})
    found = scripts(settings, tmp_path / "py", ALL)
    if problem is None:
        options = plan(found, "apriltag-locations", wanted).main.options
        assert options[:4] == (("--width", "0", "--height", "0") if wanted else ("--width", "640", "--height", "480"))
        return
    with pytest.raises(StartError, match=problem):
        plan(found, "apriltag-locations", wanted)


LISTENS = "Num RefCount Protocol Flags Type St Inode Path\n0: 00000002 00000000 00010000 0001 01 99 {}\n"


@pytest.mark.parametrize(
    ("needs", "video", "listening", "lacks", "absent"),
    [
        (Needs(), {}, "", "", ""),
        (Needs(pictures=True), {"enabled": False}, "", "it reads pictures, and services.av_daemon.video is not", "pic"),
        (Needs(pictures=True), {}, "",
         "it reads pictures at a GStreamer socket: set services.av_daemon.video.socket_path",
         "pictures at /tmp/pebble-video.sock, where nobody offers any"),
        (Needs(pictures=True), {}, "/tmp/pebble-video.sock", "", ""),
        (Needs(sound=True), {}, "/tmp/pebble-video.sock", "it reads sound at a GStreamer socket", "sound at /tmp/"),
        (Needs(hall=True), {}, "", "it reads hall samples from shared memory: set services.serial_mcu",
         "hall samples in shared memory pebble_robots_rover_odometry_raw"),
        (Needs(calibration=True), {}, "", "there is no camera_calibration.yaml beside the script or the config", ""),
    ],
)  # fmt: skip
def test_what_a_robot_offers_to_scripts_of_the_original(
    tmp_path: Path, needs: Needs, video: dict[str, Any], listening: str, lacks: str, absent: str
) -> None:
    sockets = tmp_path / "unix"
    sockets.write_text(LISTENS.format(listening))
    media = LocalMedia(config(tmp_path, "autonomy", video), sockets, tmp_path)
    for found, expected in ((media.lacks(needs, tmp_path, tmp_path), lacks), (media.absent(needs), absent)):
        assert found.startswith(expected), found
        assert bool(found) == bool(expected)
    (tmp_path / "camera_calibration.yaml").touch()
    (tmp_path / "pebble_robots_rover_odometry_raw").touch()
    assert not media.lacks(Needs(calibration=True, hall=True), tmp_path, tmp_path)

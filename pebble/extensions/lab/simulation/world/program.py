"""A simulated world as a program: its robots' MCUs behind pseudo terminals, and poses for their cameras."""

import math
import os
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

import msgspec

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.mcu import command, serve_commands
from pebble.extensions.lab.simulation.motion import Pose
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.extensions.lab.simulation.world.pose_page import PERIOD_S, PosePage, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose
from pebble.extensions.lab.simulation.world.walls import Floor, motion_of
from pebble.extensions.lab.simulation.world.world_file import World, read_world
from pebble.runtime.signals import EndSignal

ROOM: Final = Path(__file__).with_name("room.json")  # 4 m wide, four tags, Goob and Fred

Mcus = dict[str, PtyMcu]


def run(file: Path, folder: Path | None = None, *, trace: Path | None = None, control: bool = False) -> int:
    """Run until a signal, or with ``control`` until standard input ends. Raises PebbleError.

    ``folder`` is for serial ports, ``trace`` for files ROBOT.trace.jsonl of the lines that MCUs receive.
    """
    path = file.absolute()
    world = read_world(path)  # before signals are handled: they end a read that waits, as of a pipe
    end = EndSignal()
    usual = Path(tempfile.gettempdir(), f"pebble-world-{path.stem}")
    folder = folder or usual
    try:
        for made in (folder, trace or folder):
            made.mkdir(parents=True, exist_ok=True)
        # The usual folder is among those of all users, where another user can take its name first.
        if folder == usual and (uid := folder.lstat().st_uid) not in (0, os.getuid()):
            raise DeviceError(f"{folder} belongs to user {uid}: choose another one with --folder")
    except OSError as error:
        raise DeviceError(f"{error.filename}: {error.strerror}") from None
    with ExitStack() as stack:
        if folder == usual:
            stack.callback(_remove_empty, folder)
        page = _page(path, world)
        stack.callback(page.close)
        floor, mcus, imus = Floor(world), Mcus(), Mcus()
        for name, place in world.robots.items():
            motion, trace_file = motion_of(world, name, floor), trace_path(trace, name) if trace else None
            mcu = PtyMcu(place.kind, port_path(folder, name), trace=trace_file, motion=motion)
            mcus[name] = stack.enter_context(mcu)
            if place.imu:  # it only reads the motion, which the motor MCU's thread advances
                imus[name] = stack.enter_context(PtyMcu("goob_imu", imu_port_path(folder, name), motion=motion))
        print(_introduction(path, mcus, imus), flush=True)  # noqa: T201
        if control:
            serve_commands(lambda words: _command(mcus, words), end)
        _publish_poses(page, mcus, end)
    return 0


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # another world runs there, or its traces are in it
        folder.rmdir()


def port_path(folder: Path, robot: str) -> Path:
    """Return the path of the serial port of a robot's motor MCU."""
    return folder / f"{robot}.port"


def imu_port_path(folder: Path, robot: str) -> Path:
    """Return the path of the serial port of the robot's inertial sensor, if it has one."""
    return folder / f"{robot}.imu-port"


def trace_path(folder: Path, robot: str) -> Path:
    """Return the path of the file with the lines that a robot's MCU receives."""
    return folder / f"{robot}.trace.jsonl"


def _page(path: Path, world: World) -> PosePage:
    try:
        return PosePage(page_path(path), world.robots)
    except DeviceError as error:
        raise DeviceError(f"{path}: {error}") from None


def _publish_poses(page: PosePage, mcus: Mcus, end: EndSignal) -> None:
    """Write the robots' poses to the file that their cameras read, until the end is requested."""
    due = time.monotonic()
    while not end.wait(max(0.0, due - time.monotonic())):
        due = max(due + PERIOD_S, time.monotonic())
        poses = [mcu.pose for mcu in mcus.values()]
        metres = [RobotPose(pose.x_mm / 1000, pose.y_mm / 1000, pose.heading_rad) for pose in poses]
        page.write(time.monotonic_ns(), metres)


def _introduction(path: Path, mcus: Mcus, imus: Mcus) -> str:
    """Return a text with the robots' ports, and the lines for their configs."""
    lines = [f"the world of {path} runs; Ctrl-C ends it"]
    for name, mcu in mcus.items():
        video = msgspec.json.encode({"backend": "synthetic", "device": f"{path}#{name}"}).decode()
        serial = _serial(mcu)
        if name in imus:
            serial |= {"instances": {"imu": {"protocol": "pebble_serial_v1", **_serial(imus[name])}}}
        bridge = msgspec.json.encode(serial).decode()
        lines += [f"{name}, in the services of its config:", f'    "serial_mcu_bridge": {bridge}']
        lines += [f'    "av_daemon": {{"video": {video}}}']
    return "\n".join(lines)


def _serial(mcu: PtyMcu) -> dict[str, Any]:
    return {"serial": {"port": str(mcu.symlink)}}


def _command(mcus: Mcus, words: list[str]) -> str:
    """Execute one line of standard input; return what is wrong with it, or ""."""
    if len(words) < 2 or words[0] not in mcus:
        return f"begin with a robot ({', '.join(mcus)}) and a command"
    mcu = mcus[words[0]]
    if words[1] != "place":
        problem = command(mcu, words[1:])
        return f"{problem}, place X Y DEGREES" if problem else ""
    try:
        x, y, degrees = map(float, words[2:])
        mcu.place(Pose(x * 1000, y * 1000, math.remainder(math.radians(degrees), math.tau)))
    except ValueError:
        return "place needs three numbers: metres, metres, degrees"
    return ""

"""``pebble calibrate``: measures the wheels of a robot, or its camera."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pebble.errors import PebbleError
from pebble.extensions.calibrate.wheels import Wanted, calibrate, check
from pebble.extensions.scripts.perception.odometry import Calibration, OdometrySettings
from pebble.extensions.scripts.script import Robot, Stopped
from pebble.extensions.scripts.script.program import run_for

_HELP = """Measure a robot's wheels, or its camera; docs/ext/calibrate.md explains how.

\b
    pebble calibrate wheels goob.json                  a person has a tape
    pebble calibrate wheels goob.json --truth tag      its camera sees a tag
    pebble calibrate camera goob.json --size 0.25      hold a tag before it
"""
_Config = Annotated[
    Path, typer.Argument(help="The robot's config file, on the robot.", metavar="CONFIG", show_default=False)
]
_Tag = Annotated[int, typer.Option(help="The tag's id.", min=0)]
_Size = Annotated[float, typer.Option(help="Edge of the tag's black square, in metres.", min=0.01, max=2)]
_NOTHING = "nothing was written"


class _Terminal:
    """A terminal that shows lines to a person, and reads the answers."""

    def tell(self, line: str) -> None:
        typer.echo(line)

    def ask(self, question: str) -> str:
        try:
            return input(question)
        except EOFError:
            raise PebbleError("a person has to answer: run it in a terminal, or with --truth tag") from None


def wheels(
    config: _Config,
    truth: Annotated[
        Literal["tape", "tag", "gyro"],
        typer.Option(help="What is true: tape and marks on the floor, a tag on the wall, or tape and gyroscope."),
    ] = "tape",
    length: Annotated[float, typer.Option(help="Of a straight, in metres.", min=0.3, max=10)] = 1.5,
    straights: Annotated[int, typer.Option(help="There and back, at least 4.")] = 6,
    spins: Annotated[int, typer.Option(help="Of three turns on the spot, at least 2.")] = 2,
    tag: _Tag = 13,
    size: _Size = 0.25,
    speed: Annotated[float, typer.Option(help="At half power, in metres a second, about.", min=0.02, max=3)] = 0.19,
    diameter: Annotated[float, typer.Option(help="Of a wheel in mm, about.", min=1, max=1000)] = 61.0,
    track: Annotated[float, typer.Option(help="Between the wheels in mm, about.", min=1, max=5000)] = 130.5,
    magnets: Annotated[int, typer.Option(help="Of a wheel.", min=1, max=200)] = 10,
) -> int:
    """Measure the step of each wheel and the track between them, and write odometry.json beside the config.

    The robot drives straight and spins; wheel-odometry uses the file from its next start. The robot must be up, and
    have hall sensors. It is a script: people go first, and a stop ends it. Keep 2 x 1 m of floor free.

    \b
        pebble calibrate wheels goob.json
        pebble calibrate wheels goob.json --truth tag --tag 13 --size 0.25
        pebble calibrate wheels goob.json --truth gyro --spins 4
    """
    expected = OdometrySettings(wheel_diameter_mm=diameter, track_width_mm=track, magnets=magnets)
    wanted = Wanted(
        truth=truth, length_m=length, straights=straights, spins=spins, speed_m_s=speed, tag=tag, tag_size_m=size,
        expected=expected,
    )  # fmt: skip
    check(wanted)
    results: list[Calibration] = []
    _run(config, lambda robot: results.append(calibrate(robot, _Terminal(), wanted)))
    (result,) = results
    left, right = expected.step_mm
    for name, value, expected_mm in (
        ("left step", result.left_step_mm, left),
        ("right step", result.right_step_mm, right),
        ("track", result.track_mm, track),
    ):
        typer.echo(f"{name:<11} {value:8.3f} mm, {100 * (value / expected_mm - 1):+.2f} % of what was expected")
    typer.echo(f"written: {config.parent / 'odometry.json'}; wheel-odometry uses it from its next start")
    return 0


def camera(
    config: _Config,
    tag: _Tag = 13,
    size: _Size = 0.25,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder of pictures, instead of the robot's camera.", metavar="DIR")
    ] = None,
) -> int:
    """Measure a camera's focal length and distortion, and write camera_calibration.yaml beside the config.

    Hold the tag still in all parts of the picture, near and far, and tilted: a picture is taken by itself.

    \b
        pebble calibrate camera goob.json --tag 13 --size 0.25
        pebble calibrate camera goob.json --pictures shots/
    """
    if pictures is None:
        _run(config, lambda robot: _calibrate_camera(config, robot.camera(timeout=10), tag, size), drives=False)
        return 0
    if not pictures.is_dir():
        raise typer.BadParameter(f"{pictures} is no folder", param_hint="--pictures")
    from pebble.extensions.calibrate.camera import read_folder

    _calibrate_camera(config, read_folder(pictures), tag, size, still=True)
    return 0


def register(app: typer.Typer) -> None:
    group = typer.Typer(help=_HELP, rich_markup_mode=None)
    group.command("wheels")(wheels)
    group.command("camera")(camera)
    app.add_typer(group, name="calibrate")


def _calibrate_camera(config: Path, pictures: Any, tag: int, size: float, *, still: bool = False) -> None:
    from pebble.extensions.calibrate.camera import collect, save, solve, tape_line
    from pebble.extensions.scripts.perception.camera_model import CALIBRATION
    from pebble.extensions.scripts.perception.tags import FAMILY, TagFinder

    corners, shape = collect(pictures, TagFinder(size), tag, _Terminal(), still=still)
    lens = solve(corners, shape, size)
    path = config.parent / CALIBRATION
    save(path, lens, tag, size, FAMILY)
    typer.echo(f"written: {path}: {lens.pictures} pictures, which fit to {lens.error_px:.2f} pixels")
    typer.echo(tape_line(lens, size))


def _run(config: Path, main: Any, *, drives: bool = True) -> None:
    """Run ``main`` as a script. Raises PebbleError, which also says that no file was written."""

    def run(robot: Robot) -> None:
        try:
            main(robot)
        except Stopped:
            typer.echo(f"pebble: ended; {_NOTHING}", err=True)
            raise
        except PebbleError as error:
            raise PebbleError(f"{error}; {_NOTHING}") from None

    run_for(config, run, name="calibrate", drives=drives)

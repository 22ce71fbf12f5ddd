"""Extensions: ours, a package of others, an owner's file; missing ones, broken ones, two that want the same."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import reduce
from pathlib import Path
from typing import Any

import pytest

from pebble.commands import app
from pebble.config import load, parse
from pebble.config.types import Section
from pebble.errors import ConfigError
from pebble.extension import OURS, Command, Extension, Stage, lacking_packages, ours, part, programs_of
from pebble.launcher.programs import programs
from tests.support import ROOT, needs_root, some

PLACES = dict(zip([extension.name for extension in ours()], OURS, strict=True))
#: What a section needs besides being enabled.
NEEDED: dict[str, dict[str, Any]] = {
    "services.video_stream": {"command": ["cat"]},
    "services.neighbours": {"lan": {"connect": ["tcp/hub.lab:7447"]}},
}
#: Of a minimal robot: the modules of ours that are imported before the first fork, each about 0.4 ms of its start.
BUDGET, OF_EXTENSIONS = 222, 51
BEFORE_A_FORK = """
import sys
from pathlib import Path
from pebble.config import load
from pebble.launcher.launcher import Launcher
from pebble.launcher.programs import preload, programs, shared_modules
config = load(Path("configs/minimal.json"))
preload(shared_modules(config, programs(config)))
print(*(name for name in sys.modules if name.partition(".")[0] == "pebble"))
"""


def test_a_minimal_robot_imports_no_more_than_its_budget() -> None:
    done = subprocess.run([sys.executable, "-c", BEFORE_A_FORK], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    added = [name for name in loaded if any(f"{name}.".startswith(f"{module}.") for module in OURS)]
    assert len(loaded) <= BUDGET, loaded
    assert len(added) <= OF_EXTENSIONS, added


@pytest.mark.parametrize("extension", ours(), ids=lambda extension: extension.name)
class TestOurs:
    def test_its_page_its_keys_and_its_parts_are_there(self, extension: Extension) -> None:
        assert (ROOT / extension.page).is_file()
        assert tuple(extension.sections) == OURS[PLACES[extension.name]]
        hooks = (extension.rules, extension.programs, extension.offers, extension.facts, extension.checks)
        commands = [command.place for command in extension.commands.values()]
        for place in filter(None, (*hooks, *extension.sections.values(), *extension.completions.values(), *commands)):
            assert part(place) is not None
        assert all(issubclass(part(place), Section) for place in extension.sections.values())
        assert lacking_packages(extension) == []

    def test_a_config_that_enables_it_is_accepted(self, extension: Extension, tmp_path: Path) -> None:
        raw: dict[str, Any] = {"robot": {"id": "goob"}}
        for key, place in extension.sections.items():
            *outer, name = key.split(".")
            target = reduce(lambda section, step: section.setdefault(step, {}), outer, raw)
            target[name] = NEEDED.get(key, {}) | (
                {"enabled": True} if "enabled" in part(place).__struct_fields__ else {}
            )
        config = parse(raw, folder=tmp_path, env={})
        names = [program.name for program in programs_of([extension], config)]
        assert names == ([extension.program.name] if extension.program else [*extension.motors.values()])


def test_to_declare_costs_a_robot_nothing() -> None:
    code = "import sys; from pebble.extension import OURS, ours; known = {*sys.modules}; ours();"
    code += "places = {*OURS, *(place.rpartition('.')[0] for place in OURS)};"
    code += "print(*{*sys.modules} - known - places - {'pebble.services'})"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "\n", "declarations import none of their parts"


LAMP = '''
from pebble.config.types import ServiceSection, doc
from pebble.extension import Command, Extension, Facts, Program
from typing import Annotated


class Lamp(ServiceSection, frozen=True, kw_only=True):
    """Blinks."""

    hz: Annotated[float, doc("How often a second.")] = 1.0


def facts(config):
    return Facts((("lamp", f"blinks {config.section(Lamp).hz:g} times a second"),))


def lamp() -> None:
    """Print that it is there."""
    print("lamp is there")


EXTENSION = Extension(
    name="%(name)s",
    package="%(name)s.py",
    sections={"services.lamp": "%(name)s:Lamp"},
    program=Program("lamp", "%(name)s", preloaded=False),
    facts="%(name)s:facts",
    commands={"lamp": Command("%(name)s:lamp", "blink")},
    motors={"lamp": "lamp"} if %(drives)s else {},
)
'''


def pebble(*words: str, path: str = "") -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [path])])}
    command = [sys.executable, "-m", "pebble.cli", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def write(folder: Path, extensions: dict[str, Any], lamp: dict[str, Any] | None = None) -> Path:
    path = folder / "robot.json"
    services = {} if lamp is None else {"lamp": lamp}
    raw = {"robot": {"id": "goob"}, "extensions": extensions, "services": services}
    path.write_text(json.dumps(raw))
    return path


def lamp_file(folder: Path, name: str, drives: bool = False) -> None:
    (folder / f"{name}.py").write_text(LAMP % {"name": name, "drives": drives})


def package(folder: Path, name: str) -> str:
    """Write an installed package with the entry point ``lamp``; returns its place on the path."""
    site = folder / "site"
    (site / f"{name}-1.dist-info").mkdir(parents=True)
    (site / f"{name}-1.dist-info" / "entry_points.txt").write_text(f"[pebble.extensions]\nlamp = {name}:EXTENSION\n")
    lamp_file(site, name)
    return str(site)


def test_an_owners_file_has_a_section_a_program_and_a_line_of_check(tmp_path: Path) -> None:
    lamp_file(tmp_path, "lamp")
    done = pebble("check", str(write(tmp_path, {"lamp.py": {}}, {"enabled": True, "hz": 4})))
    assert (done.returncode, done.stderr) == (0, "")
    assert "blinks 4 times a second" in done.stdout
    assert "processes" in done.stdout
    assert ", lamp" in done.stdout
    done = pebble("check", str(write(tmp_path, {"lamp.py": {}}, {"hzz": 4})))
    assert (done.returncode, done.stderr) == (
        1,
        'pebble: robot.json: services.lamp.hzz: unknown key, did you mean "hz"?\n',
    )


def test_a_file_that_declares_nothing_is_one_program(tmp_path: Path) -> None:
    (tmp_path / "siren.py").write_text("")
    config = load(write(tmp_path, {"siren.py": {}}))
    (program,) = programs_of(config.installed, config)
    assert (program.name, program.module, program.arguments) == ("siren", "siren", (str(config.path),))


def test_a_package_runs_code_where_a_config_names_it(tmp_path: Path) -> None:
    site = package(tmp_path, "pebble_lamp")
    named = pebble("check", str(write(tmp_path, {"lamp": {}}, {"hz": 2})), path=site)
    assert (named.returncode, "blinks 2 times a second" in named.stdout) == (0, True)
    done = pebble("check", str(write(tmp_path, {}, {"hz": 2})), path=site)
    assert (done.returncode, "services.lamp: is not read" in done.stdout) == (0, True)
    done = pebble("lamp", path=site)
    assert (done.returncode, done.stdout) == (0, "lamp is there\n")
    assert "lamp        blink" in pebble("--help", path=site).stdout


OBJECT = "from pebble.extension import *\nEXTENSION = Extension(name='lamp', package='lamp.py', %s)\n"


@pytest.mark.parametrize(
    ("source", "reason", "drives"),
    [
        (None, "there is no file ", False),
        ("1 / 0  # EXTENSION", "ZeroDivisionError: division by zero", False),
        ("1 / 0  # EXTENSION", "ZeroDivisionError: division by zero", True),
        ("EXTENSION = 1", "its EXTENSION is no pebble.extension.Extension", False),
        ("EXTENSION = exit(0)", "SystemExit: 0", False),
        (OBJECT % "sections=['lamp']", "its EXTENSION is not as pebble.extension has it: Expected `object`", False),
        (OBJECT % "sections={'services.lamp': 'json:dumps'}", 'its section "services.lamp" is no Section', False),
        (OBJECT % "sections={'x.y': 'pebble.config.types:Section'}", 'its section "x.y" is no Section', False),
        (OBJECT % "rules='lamp:Extension'", "TypeError: ", False),
        (OBJECT % "program=Program('lamp', 'absent')", "the module of its program, absent, is not installed", True),
        (OBJECT % "motors={'legs': 'absent'}", "its motors are of a program that it does not have", True),
        (OBJECT % "motors={'a/b': 'absent'}", "its name 'a/b' is not a topic level", False),
    ],
)
def test_a_broken_one_keeps_a_robot_from_starting_only_if_it_drives(
    source: str | None, reason: str, drives: bool, tmp_path: Path
) -> None:
    if source is not None:
        (tmp_path / "lamp.py").write_text(source)
    path = write(tmp_path, {"lamp.py": {"drives": drives}}, {})
    code = "from pebble.config import load; from pebble.launcher.launcher import Launcher;"
    code += f"config = load({str(path)!r}, lenient=True); print(config.warnings); Launcher(config)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode == 0, reason in done.stdout) == (not drives, True)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ("programs='lamp:fail'", "extensions: programs of lamp.py (lamp): ZeroDivisionError: division by zero"),
        ("facts='lamp:text'", "extensions: facts of lamp.py (lamp): str is no Facts"),
        ("rules='lamp:RULES'", "(the whole file): a rule of lamp.py failed: ZeroDivisionError: division by zero"),
        ("protocols=SERIAL_PROTOCOLS", 'extensions: protocol "goob_base_v1" is added by two, Pebble (core) and '),
    ],
)
def test_a_later_failure_is_one_line_that_names_the_extension(more: str, text: str, tmp_path: Path) -> None:
    source = "from pebble.config.tree import Root\n"
    source += "def fail(*_): 1 / 0\ndef text(*_): return 'x'\nRULES = [(Root, fail)]\n"
    (tmp_path / "lamp.py").write_text(source + OBJECT % more)
    done = pebble("check", str(write(tmp_path, {"lamp.py": {}})))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith(f"pebble: robot.json: {text}")


@pytest.mark.parametrize(("name", "drives"), [("torch", False), ("arm", True)])
def test_a_robot_starts_without_programs_that_cannot_be_told_unless_they_drive(
    name: str, drives: bool, tmp_path: Path
) -> None:
    more = "programs='lamp:fail'" + (", motors={'lamp': 'lamp'}" if drives else "")
    (tmp_path / f"{name}.py").write_text(("def fail(*_): 1 / 0\n" + OBJECT % more).replace("lamp", name))
    config = load(write(tmp_path, {f"{name}.py": {"drives": drives}}), lenient=True)
    assert "ZeroDivisionError" in str(config.warnings)
    assert [(lost.name, lost.drives) for lost in config.missing] == [(name, drives)]
    assert name not in [program.name for program in programs(config)]


def test_a_file_whose_import_does_not_end_is_a_broken_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.extension._IMPORT_S", 0.3)
    (tmp_path / "endless.py").write_text("EXTENSION = None\nwhile True: pass\n")
    with pytest.raises(ConfigError, match=r"extensions.endless.py: it was not imported within 0.3 s"):
        load(write(tmp_path, {"endless.py": {}}))


def test_help_is_there_although_two_packages_have_one_command(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    commands = {"lamp": Command("lamp:lamp", "")}
    pair = [Extension(name=name, package=name, commands=commands) for name in ("lamps", "lights")]
    monkeypatch.setattr(app, "packages", lambda: iter(pair))
    assert "up" in app.commands(["--help"])
    assert 'command "lamp" is added by two, lamps (lamps) and lights (lights)' in caplog.text
    with pytest.raises(ConfigError, match="added by two"):
        app.commands(["lamp"])


def test_a_section_that_is_nearly_one_of_ours_keeps_a_robot_from_starting(tmp_path: Path) -> None:
    path = write(tmp_path, {"absent.py": {}})
    path.write_text(json.dumps(json.loads(path.read_text()) | {"securty": {}}))
    with pytest.raises(ConfigError, match="securty: unknown key, did you mean"):
        load(path, lenient=True)


def test_the_core_alone_reads_a_config_with_sections_of_extensions() -> None:
    config = load(ROOT / "configs" / "goob.json", core_only=True)
    names = [program.name for program in programs(config)]
    assert names == ["zenoh_hub", "serial_mcu_bridge", "mqtt_bridge"]


def test_an_owner_of_motors_is_a_device(tmp_path: Path) -> None:
    lamp_file(tmp_path, "wheels", drives=True)
    config = load(write(tmp_path, {"wheels.py": {"drives": True}}, {"enabled": True}))
    assert [(one.name, one.stage) for one in programs_of(config.installed, config)] == [("lamp", Stage.DEVICE)]
    assert config.motor_owners == ("lamp",)


PROTOCOL = """
from pebble.contract.serial_protocols import SerialProtocol
from pebble.extension import Extension

ROW = SerialProtocol("pebble.services.serial_mcu_bridge.imu.bridge:ImuBridge", is_imu=True)
EXTENSION = Extension(name="gyro", package="gyro.py", protocols={"gyro_v1": ROW})
"""


def test_a_row_is_all_that_a_serial_protocol_needs_besides_its_service(tmp_path: Path) -> None:
    (tmp_path / "gyro.py").write_text(PROTOCOL)
    path = write(tmp_path, {"gyro.py": {}})
    raw = json.loads(path.read_text())
    line = {"enabled": True, "protocol": "gyro_v1", "serial": {"port": "/dev/gyro"}}
    path.write_text(json.dumps(raw | {"services": {"serial_mcu_bridge": line}}))
    done = pebble("check", str(path))
    assert (done.returncode, done.stderr, "gyro_v1 at /dev/gyro" in done.stdout) == (0, "", True)
    path.write_text(json.dumps(raw | {"services": {"serial_mcu_bridge": line | {"protocol": "gyro"}}}))
    assert '"pebble_serial_v1" or "gyro_v1"' in pebble("check", str(path)).stderr


LAMP_FILE, LEGS_FILE = LAMP % {"name": "lamp", "drives": False}, LAMP % {"name": "legs", "drives": True}
#: Files and entries that a check refuses, and what it says.
REFUSED: dict[str, tuple[dict[str, str], dict[str, Any], str]] = {
    "a broken file": (
        *({"lamp": "1 / 0  # EXTENSION"}, {"lamp.py": {}}),
        "robot.json: extensions.lamp.py: ZeroDivisionError: division by zero",
    ),
    "motors that are not listed": ({"legs": LEGS_FILE}, {"legs.py": {}}, 'it owns motors, write {"drives": true}'),
    "no motors": ({"lamp": LAMP_FILE}, {"lamp.py": {"drives": True}}, "it declares no motors"),
    "one file, two entries": (
        *({"lamp": LAMP_FILE}, {"lamp.py": {}, "./lamp.py": {}}),
        "is added by two, lamp.py (lamp) and lamp.py (lamp)",
    ),
    "a file that would hide a module": (
        *({"calendar": LAMP_FILE}, {"calendar.py": {}}),
        "a module is called calendar already",
    ),
    "a section of the core": (
        *({"lamp": LAMP_FILE.replace(".lamp", ".mqtt_bridge")}, {"lamp.py": {}}),
        'section "services.mqtt_bridge" is added by two, Pebble (core) and lamp.py (lamp): remove one of them',
    ),
}


@pytest.mark.parametrize(("files", "extensions", "text"), REFUSED.values(), ids=REFUSED)
def test_a_check_refuses(files: dict[str, str], extensions: dict[str, Any], text: str, tmp_path: Path) -> None:
    for name, source in files.items():
        (tmp_path / f"{name}.py").write_text(source)
    done = pebble("check", str(write(tmp_path, extensions)))
    assert (done.returncode, text in done.stderr) == (1, True)


@needs_root
@pytest.mark.parametrize(
    ("name", "user", "mode", "text"),
    [
        ("lamp.py", 65534, 0o644, "root runs no code of other users"),
        (".", 65534, 0o755, "lies in a folder of user 65534"),
        ("lamp.py", 0, 0o666, "others may write there: chmod go-w it"),
    ],
)
def test_root_runs_no_code_of_other_users(name: str, user: int, mode: int, text: str, tmp_path: Path) -> None:
    lamp_file(tmp_path, "lamp")
    os.chown(tmp_path / name, user, user)
    (tmp_path / name).chmod(mode)
    done = pebble("check", str(write(tmp_path, {"lamp.py": {}})))
    assert (done.returncode, text in done.stderr) == (1, True)


WITHOUT = """
import sys
from functools import reduce
from pathlib import Path
sys.modules[{module!r}] = None
from pebble.errors import ConfigError
from pebble.config import parse
from pebble.extension import OURS, ours
from pebble.launcher.launcher import Launcher
print(*(extension.name for extension in ours()))
for key in OURS[{module!r}]:
    raw = {{"robot": {{"id": "goob"}}}}
    *outer, name = key.split(".")
    target = reduce(lambda section, step: section.setdefault(step, {{}}), outer, raw)
    target[name] = {{"enabled": True}} if outer else {{}}
    try:
        parse(raw, folder=Path("/"), env={{}})
    except ConfigError as error:
        print(error)
    if outer:
        target[name] = {{"enabled": False, "unknown": 1}}
        parse(raw, folder=Path("/"), env={{}})
"""


@pytest.mark.parametrize("name", some(PLACES, 5))
def test_without_one_the_core_and_all_others_start_but_those_that_need_it(name: str) -> None:
    lost = {name}
    for extension in ours():
        if lost & {*extension.needs}:
            lost.add(extension.name)
    code = WITHOUT.format(module=PLACES[name])
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    installed, *problems = done.stdout.splitlines()
    assert (done.stderr, {*PLACES} - {*installed.split()}) == ("", lost)
    assert [line.partition(": ")[0] for line in problems] == [*OURS[PLACES[name]]]
    assert all("is not installed: pip install" in line for line in problems)

"""What `apt install` does and `apt remove` leaves; a newer package, and the way back to the older one."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import pytest

from tests.ext.install.life.conftest import NEW, OLD, Packages
from tests.ext.install.life.robots import Robot
from tests.kit.machine import Machine

UNITS = ("pebble.service", "pebble-slot.service")


def test_twice_built_is_equal_byte_for_byte(packages: Packages, tmp_path: Path) -> None:
    packages.build(OLD, tmp_path / "again")
    first, second = (
        {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}
        for folder in (packages.of(OLD), tmp_path / "again")
    )
    first.pop("RELEASE.json.minisig")
    assert first == second
    assert [name.rpartition(".")[2] for name in sorted(first)] == ["json", "SHA256SUMS", "deb", "whl", "gz", "txt"]
    subprocess.run(["sha256sum", "--quiet", "--check", "SHA256SUMS"], cwd=tmp_path / "again", check=True)


def test_units_are_clean_and_confined(machine: Machine) -> None:
    machine.run("pebble-slot", "choose")
    assert machine.run("systemd-analyze", "verify", "--man=no", *UNITS) == ""
    assert [unit for unit in UNITS if machine.exposure(unit) > 2.0] == []
    assert machine.run("dpkg", "--verify", "pebble-robot") == ""
    assert machine.run("/bin/sh", "-c", "setpriv --reuid nobody --clear-groups pebble --version") == f"pebble {OLD}\n"


def test_a_newer_package_is_built_beside_and_the_older_one_is_one_command_away(
    machine: Machine, packages: Packages
) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    deb = f"/mnt/{packages.folder.name}/{NEW}/*.deb"
    assert "Building slot b" not in machine.sh(f"PIP_NO_INDEX=1 apt-get install --quiet --yes {deb}", timeout=300)
    assert machine.run("pebble", "--version") == f"pebble {OLD}\n", "without a network the older one stays"
    assert robot.runs_from() == "a"

    machine.run("pebble-slot", "take", "--wheels", "/mnt/wheels", timeout=600)
    assert machine.run("pebble", "--version") == f"pebble {NEW}\n"
    assert robot.runs_from() == "a", "what drives is not restarted"
    assert robot.receives("outgoing/online")
    machine.run("systemctl", "restart", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "b"

    machine.run("mv", "/opt/pebble/b/bin/python3", "/opt/pebble/b/bin/python3.gone")
    machine.run("systemctl", "restart", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "a", "a slot that is damaged is passed over"
    assert "pebble-slot: slot b is damaged, so a starts" in machine.journal("pebble.service")
    assert machine.run("pebble", "--version") == f"pebble {OLD}\n"
    machine.run("mv", "/opt/pebble/b/bin/python3.gone", "/opt/pebble/b/bin/python3")
    machine.run("systemctl", "restart", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "b", "mended, it is chosen again"

    machine.run("pebble-slot", "back")
    machine.run("systemctl", "restart", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "a"
    machine.cut()
    machine.boot()
    robot.plug_in()
    assert robot.receives("outgoing/online"), "it starts with the machine"
    assert robot.runs_from() == "a"


def test_a_signed_release_is_taken_and_a_changed_or_older_one_leaves_the_slots_alone(
    machine: Machine, packages: Packages
) -> None:
    files = "RELEASE.json RELEASE.json.minisig robot.txt pebble_robot-*.whl"
    machine.sh(f"mkdir /srv/new && cd /mnt/{packages.folder.name}/{NEW} && cp {files} /srv/new")
    before = machine.sh("find /opt/pebble -printf '%p %T@ %l\n' | sort")
    machine.sh("cp -r /srv/new /srv/bad && printf x >>/srv/bad/robot.txt")
    refused = machine.run("pebble-slot", "take", "--wheels", "/mnt/wheels", "/srv/bad", check=False)
    assert refused == "pebble: refused: robot.txt is not what RELEASE.json names: fetch it again\n"
    after = machine.sh("find /opt/pebble -printf '%p %T@ %l\n' | sort")
    assert after.splitlines()[1:] == before.splitlines()[1:]

    machine.run("pebble-slot", "take", "--wheels", "/mnt/wheels", "/srv/new", timeout=600)
    assert machine.run("pebble", "--version") == f"pebble {NEW}\n"
    assert machine.run("cat", "/var/lib/pebble-update/sequence") == "2\n"
    again = machine.run("pebble-slot", "take", "/srv/new", check=False)
    assert again == "pebble: refused: release 0.2.0 is number 2, and number 2 was taken here\n"


@pytest.mark.parametrize(("how", "left"), [("remove", True), ("purge", False)])
def test_a_removal_keeps_everything_and_a_purge_nothing(machine: Machine, how: str, left: bool) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    machine.sh("mkdir /etc/mosquitto/pebble; touch /etc/mosquitto/conf.d/pebble.conf")
    machine.run("apt-get", how, "--quiet", "--yes", "pebble-robot")
    assert not machine.succeeds("systemctl", "--quiet", "is-active", "pebble.service")
    assert not machine.succeeds("test", "-e", "/usr/bin/pebble")
    kept = ("/etc/pebble/robot.json", "/var/lib/pebble", "/var/lib/pebble-update/sequence", "/opt/pebble/a/bin/pebble")
    paths = (*kept, "/etc/mosquitto/pebble", "/etc/mosquitto/conf.d/pebble.conf")
    assert [path for path in paths if machine.succeeds("test", "-e", path) != left] == []

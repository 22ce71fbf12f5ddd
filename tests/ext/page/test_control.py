"""Pages at a real server and a real broker: what reaches the robot, and what does not."""

from __future__ import annotations

import time

from pebble.extensions.fleet.roles import Role, page_rights
from tests.ext.page.attacker import Hall
from tests.kit.played_robot import RecordingRobot
from tests.support import until

ZERO = {"x": 0.0, "z": 0.0, "y": 0.0}
FINAL = {**ZERO, "valid_ms": 0}


def last(robot: RecordingRobot):
    drives = robot.drives()
    return drives[-1] if drives else None


def test_with_the_lease_a_gesture_moves_the_robot_and_its_release_stops_it(served, page, robot):
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: page.refused)
    assert page.refused[0] == {
        "op": "refused", "cmd": "drive", "ref": robot.base, "why": "Take control to drive", "g": 1, "n": 0,
    }  # fmt: skip
    assert page.take(robot.base)
    page.drive(robot.base, 2, z=0.5)
    assert until(lambda: last(robot) == {"x": 0.0, "z": 0.5, "y": 0.0, "valid_ms": 400})
    page.drive(robot.base, 2)
    assert until(lambda: last(robot) == ZERO)
    assert [one["z"] for one in robot.drives()] == [0.5, 0.0], "nothing of the first gesture"
    page.send("estop", ref=robot.base, stop="00000000000000ff", why="button")

    def noted():
        return [one.what for one in served.app.state.audit.read(100) if one.ref == robot.base]

    assert until(lambda: noted() == ["take", "drive", "stop"], 3), noted()


def test_a_silent_page_is_stopped_and_its_gesture_is_over(page, robot):
    assert page.take(robot.base)
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: last(robot) == FINAL, 1)
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: any(one["why"] == "Let go first" for one in page.refused))
    time.sleep(0.35)  # repetitions of the zero
    page.drive(robot.base, 2, z=0.5)
    assert until(lambda: last(robot)["z"] == 0.5)


def test_a_clock_that_jumps_ends_the_connection(page, robot):
    assert page.take(robot.base)
    page.drive(robot.base, 2, z=0.5, age_ms=-5000)
    assert until(lambda: page.closed)
    assert "jumped" in page.bye["why"]
    assert until(lambda: not robot.drives() or last(robot) == FINAL)


def test_an_emergency_stop_is_repeated_until_the_robot_confirms_and_a_reset_names_what_was_shown(page, robot):
    page.send("estop", ref=robot.base, stop="00000000000000aa", why="button")
    assert until(lambda: page.value(robot.base, "web/estop", "sending") == "confirmed")
    view = page.value(robot.base, "web/estop")
    assert (view["latched"], view["by"], view["stop"]) == (True, "somebody at this computer", "00000000000000aa")
    assert page.take(robot.base)
    page.drive(robot.base, 1, z=0.5)
    assert until(lambda: page.refused)
    assert page.refused[0]["why"] == "Stopped by somebody without a login"
    (owner,) = view["owners"]
    shown = {key: owner[key] for key in ("owner", "boot", "count")}
    page.send("estop-reset", ref=robot.base, owners=[{**shown, "count": 99}])
    time.sleep(0.3)
    assert robot.latched
    page.send("estop-reset", ref=robot.base, owners=[shown])
    assert until(lambda: page.value(robot.base, "web/estop", "latched") is False)


def test_what_is_drawn_over_a_picture_comes_with_it(served, broker, page, robot):
    with RecordingRobot(broker.port, f"{robot.base}-eye") as eye:
        assert page.knows(eye.base)
        page.send("picture-from", ref=robot.base, source=eye.base)
        page.send("watch", ref=robot.base)

        def drawn():
            eye.publish("video-overlays", {"shapes": [[[0, 0], [1, 1]]]})
            eye.publish("sensors/imu", {"value": 1})
            return page.value(eye.base, "video-overlays")

        assert until(drawn)
        assert page.value(eye.base, "sensors/imu") is None
        page.send("picture-from", ref=robot.base, source="")
        assert until(lambda: page.value(robot.base, "web/picture-from", "source") == "")
        page.state.pop((eye.base, "video-overlays"))
        eye.publish("video-overlays", {"shapes": [[[0, 0], [1, 0]]]})
        eye.publish("charging-level", {"value": 7.0})
        assert until(lambda: page.value(eye.base, "charging-level"))
        assert page.value(eye.base, "video-overlays") is None


def test_only_who_has_the_right_takes_control_over(broker, tmp_path):
    with (
        Hall(broker.port, tmp_path) as hall,
        RecordingRobot(broker.port, "pebble/robots/keeping", keeps=True) as robot,
        hall.page("admin") as admin,
    ):
        assert admin.knows(robot.base)
        assert admin.take(robot.base)
        for role in Role:
            with hall.page(role.value) as page:
                assert page.knows(robot.base)
                assert page.take(robot.base, over=True) is ("take" in page_rights(role)), role

"""The newest line of a kind replaces older ones, and an expired drive line becomes the stop."""

from pebble.services.serial_mcu_bridge.line.outbox import Outbox


def test_only_the_newest_of_a_kind_is_left() -> None:
    outbox = Outbox(b"stop", 0.75)
    for number in range(1000):
        outbox.drive(b"%d" % number, 0.0, 0.75)
        outbox.put("lights", b"L%d" % number)
    assert (outbox.take(0.1), outbox.take(0.1), outbox.take(0.1)) == (b"999", b"L999", None)
    assert outbox.superseded == 2 * 999


def test_driving_goes_first() -> None:
    outbox = Outbox(b"stop", 0.75)
    outbox.put("lights", b"lights")
    outbox.drive(b"drive", 0.0, 0.75)
    assert outbox.take(0.0) == b"drive"


def test_a_drive_line_that_waited_too_long_is_a_stop() -> None:
    outbox = Outbox(b"stop", 0.75)
    outbox.drive(b"drive", 10.0, 0.75)
    assert outbox.take(10.76) == b"stop"
    assert outbox.expired == 1
    assert not outbox.waiting


def test_a_drive_line_may_be_valid_for_less_than_the_timeout_but_not_for_longer() -> None:
    outbox = Outbox(b"stop", 0.75)
    outbox.drive(b"drive", 10.0, 0.1)
    assert outbox.take(10.11) == b"stop"
    outbox.drive(b"drive", 10.0, 5.0)
    assert outbox.take(10.76) == b"stop"


def test_the_stop_and_the_lights_never_expire() -> None:
    outbox = Outbox(b"stop", 0.75)
    outbox.drive(b"drive", 0.0, 0.75)
    outbox.halt()
    outbox.put("lights", b"lights")
    assert (outbox.take(1e9), outbox.take(1e9)) == (b"stop", b"lights")
    assert outbox.expired == 0


def test_a_command_after_the_stop_counts() -> None:
    outbox = Outbox(b"stop", 0.75)
    outbox.halt()
    outbox.drive(b"drive", 0.0, 0.75)
    assert outbox.take(0.0) == b"drive"
    outbox.clear()
    assert outbox.take(0.0) is None

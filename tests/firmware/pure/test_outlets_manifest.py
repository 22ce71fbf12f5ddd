"""What a station of switched sockets tells about itself: tests/firmware/test_outlets.py reads it as the host does."""

from common.frames import Sender
from outlets.manifest import HELLO_SIZE, manifest


def test_its_hello_counts_the_interfaces():
    for count in (1, 4, 9):
        hello = manifest(count)[:HELLO_SIZE]
        assert hello[1] == 2 * count
        assert hello.endswith(b"\x11seeed-xiao-samd21")


def test_it_fits_the_ring_of_the_board():
    sender = Sender(768)  # as in robot.py
    assert sender.send(3, 0, 0xFFFFFFFF, 0x3FFFFFFF, manifest(4))


def test_each_outlet_has_its_own_topics():
    whole = manifest(4)
    for n in range(1, 5):
        assert b"\x10outlets/o%d/power" % n in whole
        assert b"\x11outlets/o%d/status" % n in whole

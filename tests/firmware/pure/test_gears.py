"""What Fred's motors get for what the host wants."""

from fred.gears import Gears


def near(pair, left, right):
    return abs(pair[0] - left) < 1e-6 and abs(pair[1] - right) < 1e-6


def test_no_way_back_right_after_a_way_ahead():
    gears = Gears()
    gears.limit(1.0, 1.0, 1000)
    assert near(gears.limit(-1.0, -1.0, 1000), 0.0, 0.0)
    assert near(gears.limit(-1.0, -1.0, 1339), 0.0, 0.0)
    assert near(gears.limit(-1.0, -1.0, 1340), -0.651, -0.7)


def test_turning_stays_possible():
    gears = Gears()
    gears.limit(1.0, 1.0, 0)
    assert near(gears.limit(-1.0, 0.0, 100), -0.465, 0.5)
    assert near(gears.limit(1.0, -1.0, 100), 0.93, -1.0)


def test_only_more_ahead_than_turning_blocks():
    gears = Gears()
    gears.limit(1.0, 0.0, 0)  # as much one as the other
    assert near(gears.limit(-1.0, -1.0, 1), -0.651, -0.7)
    gears.limit(1.0, 0.1, 10)
    assert near(gears.limit(-1.0, -1.0, 11), 0.0, 0.0)

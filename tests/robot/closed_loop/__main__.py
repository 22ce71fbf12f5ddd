"""Measures a robot that drives by itself: ``python -m tests.robot.closed_loop --transport zenoh --starts 20``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable

from tests.robot.closed_loop import following, perception, stops
from tests.robot.closed_loop.aims import AIMS, Samples, table
from tests.robot.world_rig import WorldRig
from tests.support import until

Part = Callable[[WorldRig, argparse.Namespace], Samples]


def _merged(found: Iterable[Samples]) -> Samples:
    merged: Samples = {}
    for samples in found:
        for key, values in samples.items():
            merged.setdefault(key, []).extend(values)
    return merged


def _follow(rig: WorldRig, options: argparse.Namespace) -> Samples:
    found = []
    for number, start in enumerate(following.starts(options.starts, options.seed), 1):
        found.append(following.followed(rig, start))
        print(f"start {number}: {start.distance:.2f} m, {start.beside:+.0f}° beside, {start.off:+.0f}° off: "
              f"{found[-1]['settled'][0]:.1f} s, {found[-1]['distance'][0]:.3f} m", flush=True)  # fmt: skip
    return _merged(found)


def _memory(rig: WorldRig, _options: argparse.Namespace) -> Samples:
    found, lines = perception.memory(rig)
    print("\n".join(lines), flush=True)
    return found


def _stops(rig: WorldRig, options: argparse.Namespace) -> Samples:
    return _merged(stops.ended(rig, ending) for ending in stops.ENDINGS for _ in range(options.rounds))


PARTS: dict[str, Part] = {
    "follow": _follow,
    "stops": _stops,
    "override": lambda rig, options: _merged(stops.overridden(rig) for _ in range(options.rounds)),
    "override-here": lambda rig, options: _merged(stops.overridden_on_the_robot(rig) for _ in range(options.rounds)),
    "single-stop": lambda rig, options: _merged(stops.stopped_once(rig) for _ in range(options.stops)),
    "locations": lambda rig, _: perception.located(rig),
    "dependency": lambda rig, _: perception.crashed_dependency(rig),
    "odometry": lambda rig, options: _merged(following.measured_odometry(rig) for _ in range(options.rounds)),
    "two": lambda rig, _: following.followed_robot(rig.kind),
    "original": lambda rig, options: following.followed_by_an_original(rig.kind, options.rounds, options.seed),
    "memory": _memory,
}


def main() -> int:
    options = _parser().parse_args()
    if options.wait and not until(lambda: os.getloadavg()[0] < options.load, options.wait, step=1.0):
        print(f"the machine's load did not fall below {options.load:g}")
    print(f"{options.transport}, load {os.getloadavg()[0]:.2f} of {os.cpu_count()} cores", flush=True)
    found: Samples = {}
    failed = []
    for name in options.only or PARTS:
        print(f"-- {name}", flush=True)
        try:
            with WorldRig(options.transport) as rig:
                found = _merged([found, PARTS[name](rig, options)])
        except AssertionError as error:  # the other parts are measured all the same
            failed.append(f"{name} FAILED: {error}")
    print("\n".join([*table(found, options.transport), *failed]))
    return 0 if not failed and all(AIMS[key].holds(samples) for key, samples in found.items()) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.robot.closed_loop", description=__doc__)
    parser.add_argument("--transport", choices=("zenoh", "mqtt", "single"), required=True, help="single: one broker")
    parser.add_argument("--starts", type=int, default=20, metavar="N", help="of apriltag-follow, at random places")
    parser.add_argument("--seed", type=int, default=1, help="of the places")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="of each way to stop, and of the override")
    parser.add_argument("--stops", type=int, default=20, metavar="N", help="single stops against 500 commands a second")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"some of: {', '.join(PARTS)}")
    parser.add_argument("--wait", type=float, default=0.0, metavar="S", help="at most, for the load to fall")
    parser.add_argument("--load", type=float, default=0.5, help="what --wait waits for")
    return parser


if __name__ == "__main__":
    sys.exit(main())

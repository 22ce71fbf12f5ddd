"""In MicroPython: a minute of a robot's life, and what it costs of the heap. run.mjs calls turn() again and again.

This build collects garbage between calls of turn() only. So a turn's cost is what lives before it plus everything it
allocates, as if no collection came in time. What the stand-ins allocate between turns is left out.
"""

import gc
import json

import board  # noqa: F401 - puts the hardware's modules in place
import micropython

with open("/case.json") as _file:
    case = json.load(_file)
life = __import__(case["life"]).Life(case)

baseline = imported = built = starting = live = peak = turns = 0
peak_at = stage = ""
waiting = case["modules"][::-1]
robot = build = None


def turn():
    """False when the minute is over. The first calls load one module each, the next makes the robot."""
    global baseline, imported, built, starting, peak, peak_at, live, stage, turns, robot, build
    start = gc.mem_alloc()
    if not stage:
        baseline = start
        micropython.qstr_info()
        stage = "starting"
    if stage == "starting":
        if waiting:
            build = __import__(waiting.pop(), None, None, ("build",))
        else:
            imported = start - baseline
            robot = build.build(case["settings"])
            stage = "built"
        starting = max(starting, gc.mem_alloc() - baseline)
    else:
        built = built or start - baseline
        live = max(live, start - baseline)
        stage = life.between(robot)
        if not stage:
            return report()
        turns += 1
        before = gc.mem_alloc()
        robot.step()
        cost = start + gc.mem_alloc() - before - baseline
        if cost > peak:
            peak, peak_at = cost, stage
    gc.collect()
    return True


def report():
    life.check(robot)
    micropython.qstr_info()
    names = ("baseline", "imported", "built", "starting", "live", "peak", "peak_at", "turns")
    print(json.dumps({name: globals()[name] for name in names}))
    return False


gc.collect()

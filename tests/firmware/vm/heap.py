"""In MicroPython: runs a robot for a minute and measures its heap. run.mjs calls turn() repeatedly.

This build collects garbage between calls of turn() only. So a turn's cost is the heap in use before or after it plus
everything that it allocates, or the most between two collections of its own. What the fakes allocate between turns is
excluded.
"""

import gc
import json

import board  # puts the hardware's modules in place

with open("/case.json") as _file:
    case = json.load(_file)
workload = __import__(case["workload"]).Workload(case)

baseline = imported = built = starting = live = last = peak = turns = 0
peak_at = stage = ""
waiting = case["modules"][::-1]
robot = build = None


def turn():
    """False when the minute is over. The first calls load one module each, the next makes the robot."""
    global baseline, imported, built, starting, peak, peak_at, live, last, stage, turns, robot, build
    start = gc.mem_alloc()
    if not stage:
        baseline = start
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
        if turns:  # what the turn before this one has left is known now
            cost = max(last, start) + board.Gc.most - baseline
            if cost > peak:
                peak, peak_at = cost, stage
        live = max(live, start - baseline)
        stage = workload.between(robot)
        if not stage:
            return report()
        turns += 1
        board.Gc.most = 0
        board.Gc.start = gc.mem_alloc()
        robot.step()
        board.Gc.collect()
        last = start
    gc.collect()
    return True


def report():
    workload.check(robot)
    names = ("baseline", "imported", "built", "starting", "live", "peak", "peak_at", "turns")
    print(json.dumps({name: globals()[name] for name in names}))
    return False


gc.collect()

"""In MicroPython: repeats the calls of /traces.jsonl on latch, lease and arbiter, and compares every result."""

import gc
import json

from common import ticks
from common.arbiter import Arbiter
from common.latch import Latch, is_name, reset_of, stop_of
from common.lease import Lease

traces = open("/traces.jsonl")  # noqa: SIM115 - read in turns
count = calls = 0
ok = True


def _subtract(later, earlier):
    return later - earlier


class _Keys:
    def __init__(self, first):
        self.next = first

    def __call__(self, _count):
        self.next += 1
        return f"{self.next - 1:08x}"


def _plain(result):
    """The value as it is after JSON: tuples are lists."""
    return list(result) if isinstance(result, tuple) else result


def _all(lease):
    return [lease.key, list(lease.holder), list(lease.asker), lease.others, lease.changed, lease.halts]


def bodies():
    for body, stop, reset, name in json.loads(traces.readline()):
        if [_plain(stop_of(body)), _plain(reset_of(body)), is_name(body)] != [stop, reset, name]:
            print("a body differs:", body)


def repeat(trace):
    global calls
    latches = {}
    leases = {}
    arbiters = {}
    diffs = {}
    for number, method, arguments, expected in trace:
        calls += 1
        result = None
        if method == "latch":
            diffs[number] = ticks.diff if arguments[1] == 4 else _subtract
            latches[number] = Latch(arguments[0], arguments[1], diffs[number])
        elif method == "lease":
            now, first, strangers = arguments
            leases[number] = Lease(now, diffs[number], _Keys(first), strangers)
        elif method == "arbiter":
            arbiters[number] = Arbiter(latches[number], leases[number], arguments[0], diffs[number], arguments[1])
        elif method == "hold" or method == "release":
            getattr(leases[number], method)(tuple(arguments[0]), *arguments[1:])
            result = _all(leases[number])
        elif method == "judge":
            result = [arbiters[number].judge(*arguments), arbiters[number].barred]
            result += _all(leases[number])  # MicroPython has no star in a list
        elif method == "restore":
            latches[number].restore(*arguments)
            result = latches[number].saved()
        elif method == "reset":
            result = [latches[number].reset(*arguments), latches[number].saved()]
        elif method == "state":
            result = latches[number].state(*arguments)
        elif method == "tick":
            arbiters[number].tick(*arguments)
            result = arbiters[number].barred
        else:
            result = [getattr(arbiters[number], method)(*arguments), arbiters[number].barred]
        if number in leases:
            leases[number].halts = False  # as an owner of motors does, after halting them
        if result != expected:
            print("differs:", method, arguments, expected, result)
            return False
    return True


def turn():
    global count, ok
    for _ in range(50):
        line = traces.readline()
        if not line or not ok:
            print(json.dumps([count, calls, ok]))
            return False
        ok = repeat(json.loads(line))
        count += 1
    gc.collect()
    return True


bodies()

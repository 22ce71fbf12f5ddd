"""Measures bytes on the wire, plain and in groups: ``python -m tests.ext.thin.wire_bytes [SECONDS [FOLDER]]``.

With a folder it draws wire-bytes.png there.

Two network namespaces and a real mosquitto; the counters are those of the robot's interface: Ethernet, IP, TCP and
acknowledgements. Needs root, as `pebble impair` does.
"""

# ruff: noqa: T201
import itertools
import json
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from pebble.contract import DRIVE, EXPANDER, GROUP, IMU, LIGHTS_SOLID, ONLINE, STREAMS, TOUCH_SENSORS, WHEEL_ODOMETRY
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.impair.network import REMOTE_HOST, NamespaceNetwork
from pebble.extensions.lab.bench.results import Cell, round_cell
from pebble.extensions.thin.packed import joined, packed
from pebble.transports import MqttSettings, QoS, create

BASE, PORT = "pebble/robots/goob", 18830
SHORT = "~/3f"
_random = random.Random(1)
Sent = tuple[str, bytes, int, bool]  # topic, payload, QoS, retained


def text(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def drive() -> dict[str, object]:
    return {"x": round(_random.uniform(-1, 1), 3), "z": 0.742, "valid_ms": 400}


def lights() -> dict[str, object]:
    return {"r": 0.2, "g": 0.7, "b": 1.0}


def touch() -> bytes:
    return text({"value": {f"a{number}": _random.randint(380, 640) for number in range(3)}, "unit": "adc"})


def odometry() -> bytes:
    x, y, left, right = (round(_random.uniform(0, 4000), 1) for _ in range(4))
    value = {"x": x, "y": y, "heading": round(_random.uniform(-3, 3), 4), "left_mm": left, "right_mm": right}
    return text({"value": value, "timestamp": time.time(), "unit": "mm"})


def imu() -> bytes:
    three = [round(_random.gauss(0, 1), 4) for _ in range(6)]
    value = {
        "accel_mps2": dict(zip("xyz", three[:3], strict=True)),
        "gyro_dps": dict(zip("xyz", three[3:], strict=True)),
        "temp_c": round(_random.gauss(31, 0.05), 3),
        "orientation_deg": {"roll": three[0], "pitch": three[1]},
        "accel_norm_g": round(_random.gauss(1, 0.01), 4),
        "gyro_bias_dps": {"x": 0.11, "y": -0.2, "z": 0.05},
        "health": {"device": "/dev/ttyUSB0", "protocol": "pebble_serial_v1", "samples_ok": 12345, "samples_error": 0},
    }
    return text({"t": int(1000 * time.time()), "seq": 1000, "mcu_ms": 123456, "value": value})


STREAMS_OF = {TOUCH_SENSORS: touch, IMU: imu, WHEEL_ODOMETRY: odometry}
DICTIONARY = joined({channel.metric: make() for channel, make in STREAMS_OF.items()})


def heartbeat() -> Sent:
    return ONLINE.topic(BASE), text({"t": int(1000 * time.time())}), 1, True


def plain(*channels: object) -> list[Sent]:
    return [(c.topic(BASE), STREAMS_OF[c](), c.default_qos, False) for c in channels]  # type: ignore[attr-defined,index]


def group(dictionary: bytes, topic: str) -> list[Sent]:
    raw = packed(joined({channel.metric: make() for channel, make in STREAMS_OF.items()}), 7, dictionary)
    return [(topic, raw, 0, False)]


def pair(qos: int) -> list[Sent]:
    return [(DRIVE.topic(BASE), text(drive()), qos, False), (LIGHTS_SOLID.topic(BASE), text(lights()), 1, False)]


def company(qos: int) -> list[Sent]:
    return [(GROUP.topic(BASE), text({DRIVE.metric: drive(), LIGHTS_SOLID.metric: lights()}), qos, False)]


#: By name: the side that sends, and what is sent so often a second.
FLOWS: dict[str, tuple[str, list[tuple[float, Callable[[], list[Sent]]]]]] = {
    "drive + lights 10 Hz, two messages": ("remote", [(10, lambda: pair(1))]),
    "drive + lights 10 Hz, a group": ("remote", [(10, lambda: company(1))]),
    "drive + lights 10 Hz, drive with QoS 0": ("remote", [(10, lambda: pair(0))]),
    "drive + lights 10 Hz, a group with QoS 0": ("remote", [(10, lambda: company(0))]),
    "streams at full rate": (
        "robot",
        [
            (50, lambda: plain(TOUCH_SENSORS)),
            (5, lambda: plain(IMU)),
            (20, lambda: plain(WHEEL_ODOMETRY)),
            (4, lambda: [heartbeat()]),
        ],
    ),
}  # fmt: skip
_BEATS: tuple[float, Callable[[], list[Sent]]] = (1, lambda: [heartbeat()])
for _hz in (5, 2, 1):
    for _name, _make in {
        "each by itself": lambda: plain(*STREAMS_OF),
        "groups": lambda: group(b"", STREAMS.topic(BASE)),
        "groups, deflate": lambda: group(DICTIONARY, STREAMS.topic(BASE)),
        "groups, deflate, short name": lambda: group(DICTIONARY, SHORT),
    }.items():
        FLOWS[f"streams {_hz} Hz, {_name}"] = ("robot", [(_hz, _make), _BEATS])


def counters() -> tuple[int, int, int]:
    """Return bytes received and sent, and packets of both, by this namespace's interface."""
    line = next(line for line in Path("/proc/net/dev").read_text().splitlines() if line.strip().startswith("wire:"))
    values = [int(value) for value in line.partition(":")[2].split()]
    return values[0], values[8], values[1] + values[9]


def due(rates: list[tuple[float, Callable[[], list[Sent]]]], seconds: float) -> Iterator[tuple[float, list[Sent]]]:
    """Yield when to send what, in order."""
    times = [(number / hz, index) for index, (hz, _) in enumerate(rates) for number in range(int(seconds * hz))]
    yield from ((at, rates[index][1]()) for at, index in sorted(times))


def end(side: str, flow: str, seconds: float) -> None:
    """Be the robot or the rest of the world for one flow."""
    sender, rates = FLOWS[flow]
    transport = create("mqtt", f"{side}-{time.time_ns()}", MqttSettings(host=REMOTE_HOST, port=PORT)).open(10)
    direction = "incoming" if side == "robot" else "outgoing"
    for filter_ in (f"{BASE}/{direction}/#", *([SHORT] if side == "remote" else [])):
        transport.subscribe(filter_, lambda _message: None, qos=QoS(1), direct=True)
    time.sleep(2.0)
    if side == "remote" and "groups" in flow:  # an expander says that it is there
        sign = {"id": "0badf00d"} | ({"short": SHORT} if "short" in flow else {})
        rates = [(0.5, lambda: [(EXPANDER.topic(BASE), text(sign), 1, False)])]
        sender = "remote"
    before, began = counters(), time.monotonic()
    for at, messages in due(rates, seconds) if sender == side else ():
        time.sleep(max(0.0, began + at - time.monotonic()))
        for topic, payload, qos, retained in messages:
            transport.publish(topic, payload, qos=QoS(qos), retain=retained)
    time.sleep(max(0.0, began + seconds + 0.5 - time.monotonic()))
    came, went, packets = (now - then for now, then in zip(counters(), before, strict=True))
    print(json.dumps({"came": came / seconds, "went": went / seconds, "packets": packets / seconds}))


def main(seconds: float) -> list[Cell]:
    network = NamespaceNetwork("wire")
    folder = tempfile.TemporaryDirectory(prefix="wire")
    cells: list[Cell] = []
    config = Path(folder.name, "mosquitto.conf")
    Path(folder.name).chmod(0o755)
    config.write_text(f"listener {PORT} {REMOTE_HOST}\nallow_anonymous true\n")
    broker = subprocess.Popen(network.on_remote(["/usr/sbin/mosquitto", "-c", str(config)]), stderr=subprocess.DEVNULL)
    try:
        time.sleep(1.0)
        print(f"{'':42}{'to robot':>10}{'from robot':>12}{'both':>8}{'kbit/s':>8}{'packets/s':>11}")
        for flow in FLOWS:
            command = [sys.executable, "-m", "tests.ext.thin.wire_bytes", "--end"]
            ends = [
                subprocess.Popen(wrap([*command, side, flow, str(seconds)]), stdout=subprocess.PIPE, text=True)
                for side, wrap in (("robot", network.on_robot), ("remote", network.on_remote))
            ]
            robot, _ = (json.loads(process.communicate(timeout=seconds + 60)[0]) for process in ends)
            both = robot["came"] + robot["went"]
            numbers = f"{robot['came']:>10.0f}{robot['went']:>12.0f}{both:>8.0f}{both * 8 / 1000:>8.1f}"
            print(f"{flow:42}{numbers}{robot['packets']:>11.1f}", flush=True)
            if hz := re.match(r"streams (\d) Hz, (.*)", flow):
                cells.append(round_cell(hz[2], "both ways", "bytes a second", [both], {"groups a second": int(hz[1])}))
    finally:
        broker.terminate()
        network.close()
        folder.cleanup()
    return cells


def draw(cells: list[Cell], folder: Path) -> None:
    caption = "Touch, inertial sensor and odometry at the robot's interface, with a heartbeat a second"
    for picture in plots.lines("wire-bytes", caption, cells, over="groups a second"):
        plots.save(picture, folder, quick=False)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--end"]:
        end(sys.argv[2], sys.argv[3], float(sys.argv[4]))
    else:
        measured = main(float(next(itertools.islice(sys.argv, 1, None), "20")))
        if sys.argv[2:]:
            draw(measured, Path(sys.argv[2]))

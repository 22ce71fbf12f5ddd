"""A rig whose browser is behind an impaired network, by the namespaces of pebble impair; needs root."""

from __future__ import annotations

import ctypes
import os
import shlex
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.network import ROBOT_HOST as SERVER
from pebble.bench.impair.network import NamespaceNetwork, why_no_namespaces
from pebble.bench.page_cases import KEY, ROBOT, Samples, driven_by_others, reset
from pebble.bench.page_rig import Rig, monotonic, rig
from pebble.contract import CAMERA, CAPABILITIES, MQTT_VIDEO, ONLINE, VIDEO_CONTROL, codec
from pebble.contract.payloads import Capabilities, Heartbeat
from pebble.errors import PebbleError
from pebble.media.scene import Scene
from pebble.media.video import make_encoder
from pebble.transports import MqttSettings, QoS, create

#: Up is from the server to the page.
THIN = Condition("2 Mbit/s", up=Shape(kbit=2000))
FAR = Condition("256 kbit/s, 100 ms, 2 %", up=Shape(kbit=256, loss=0.02, delay_ms=50), down=Shape(delay_ms=50))
_PORT = 8080
_CLONE_NEWNET = 0x40000000
_FPS, _SIZE = 15, (640, 360)
_OFFERED_BYTES = 35_000  # of a picture: 4.2 megabits a second


@contextmanager
def linked(condition: Condition, *names: str, wide: bool = False, flags: tuple[str, ...] = ()) -> Iterator[Rig]:
    """Everything but the browser is on one side of the network, and the browser on the other. Raises PebbleError.

    ``wide``: with a robot whose pictures are larger than the network carries. ``flags``: further ones of the browser.
    """
    problem = why_no_namespaces()
    if problem is not None:
        raise PebbleError(f"no network namespaces: {problem}")
    with ExitStack() as stack:
        network = stack.enter_context(NamespaceNetwork())
        program = _script(Path(stack.enter_context(tempfile.TemporaryDirectory())), network)
        stack.enter_context(_inside(network.on_robot(())[1].removeprefix("--net=")))
        secure = f"--unsafely-treat-insecure-origin-as-secure=http://{SERVER}:{_PORT}"  # as https would be
        made = stack.enter_context(rig(*names, program=program, flags=(secure, *flags), host=SERVER, port=_PORT))
        if wide:
            stack.callback(WideRobot(made.stage.broker_port).close)
        network.apply(condition)
        yield made


def _script(folder: Path, network: NamespaceNetwork) -> str:
    """A program that is Chromium on the far side."""
    path = folder / "chromium"
    path.write_text(f'#!/bin/sh\nexec {shlex.join(network.on_remote(["chromium"]))} "$@"\n')
    path.chmod(0o700)
    return str(path)


@contextmanager
def _inside(namespace: str) -> Iterator[None]:
    """This thread, and all that it starts, use that network."""
    libc = ctypes.CDLL(None, use_errno=True)
    own = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    other = os.open(namespace, os.O_RDONLY)
    try:
        if libc.setns(other, _CLONE_NEWNET):
            raise PebbleError(f"the network namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
        yield
    finally:
        libc.setns(own, _CLONE_NEWNET)
        os.close(own)
        os.close(other)


class WideRobot:
    """A robot that only sends pictures, four megabits of them a second, whether or not they are requested."""

    def __init__(self, port: int) -> None:
        self.base = "pebble/robots/wide"
        self._transport = create("mqtt", "wide", MqttSettings(host="127.0.0.1", port=port))
        self._transport.open()
        topics = {"topic": CAMERA, "command_topic": VIDEO_CONTROL, "flag_topic": MQTT_VIDEO}
        video = {name: channel.topic(self.base) for name, channel in topics.items()}
        value = {"video": {"available": True, "controls": True, "encodings": ["pbvd"], **video}}
        payload = codec.encode(CAPABILITIES, Capabilities(t=int(1000 * time.time()), value=value))
        self._transport.publish(CAPABILITIES.topic(self.base), payload, retain=True, qos=QoS.DELIVERED)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._film, name="wide", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._transport.close()

    def _film(self) -> None:
        scene, picture = Scene(*_SIZE), np.empty((_SIZE[1], _SIZE[0], 3), np.uint8)
        noise = np.random.default_rng(1).integers(0, 60, (8, *picture.shape), np.uint8)
        encoder = make_encoder("pbvd", fps=_FPS, quality=50)
        number, due = 0, time.monotonic()
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due += 1 / _FPS
            scene.render(number, picture)
            payload = encoder.encode(picture // 2 + noise[number % 8], int(1000 * time.time()))
            encoder.quality = min(95.0, max(5.0, encoder.quality * (_OFFERED_BYTES / len(payload)) ** 0.3))
            self._transport.publish(CAMERA.topic(self.base), payload)
            if number % _FPS == 0:
                heartbeat = codec.encode(ONLINE, Heartbeat(t=int(1000 * time.time())))
                self._transport.publish(ONLINE.topic(self.base), heartbeat)
            number += 1


# -- what is measured there


def pictures(rig: Rig, scale: float) -> Samples:
    """The age of pictures that offer more than the link carries."""
    page = rig.page("wide")
    rig.until(page, lambda: page.evaluate("bench.picture"), "no picture", 30.0)
    page.evaluate("bench.film()")
    rig.pause(page, 3.0)
    page.evaluate("bench.drawn.length = 0")
    began = time.monotonic()
    rig.pause(page, 20 * scale)
    offered = sum(size for at, ref, size in rig.frames if ref == rig.ref("wide") and at >= began)
    drawn = page.evaluate("bench.drawn")
    return {
        "2 Mbit/s: picture age": [at - captured for _, _, captured, at, _ in drawn if captured],
        "2 Mbit/s: offered": [8 * offered / 1e6 / (time.monotonic() - began)],
        "2 Mbit/s: drawn a second": [len(drawn) / (time.monotonic() - began)],
    }


def driving(rig: Rig, scale: float) -> Samples:
    """Driving, and the emergency stop, over a link that is slow, far and lossy."""
    page = rig.drivable(ROBOT)
    ref = rig.ref(ROBOT)
    page.evaluate("bench.number = 1")
    interrupted, end = -1.0, time.monotonic() + 20 * scale
    while time.monotonic() < end:
        if not page.evaluate("pebble.driver.gestureActive"):
            interrupted += 1
            page.keyboard.up(KEY)
            with suppress(PebbleError):  # the page may refuse for a while, because commands are late
                rig.ready(page)
                rig.hold(page, ROBOT, KEY)
        rig.pause(page, 0.1)
    page.keyboard.up(KEY)
    rig.pause(page, 1.0)
    sent = page.evaluate("bench.sent")
    arrived = {round(axes.get("y", 0.0), 3): at for at, base, axes in rig.drives if base == ref}
    late = [1000 * (arrived[round(y, 3)] - monotonic(at)) for y, at in sent if round(y, 3) in arrived]
    stop: list[float] = []
    driver = driven_by_others(rig)
    for _ in range(max(1, round(8 * scale))):
        driver.choose((ref,))
        rig.until(page, lambda: rig.stage.wheels_turning(ROBOT), "the robot does not move")
        page.locator("[data-test=stop-one]").click()
        pressed = rig.stamp(page, "pointer")
        stop.append(1000 * (rig.stopped(page, ROBOT) - pressed))
        driver.choose(())
        rig.until(page, lambda: page.evaluate(f"pebble.store.get('{ref}', 'web/estop')?.value.latched"), "not shown")
        reset(rig, page, [ref])
    driver.close()
    return {
        "256 kbit/s: drive": late,
        "256 kbit/s: drive, arrived": [100 * len(late) / max(1, len(sent))],
        "256 kbit/s: gestures interrupted": [interrupted],
        "256 kbit/s: STOP to motors": stop,
        "256 kbit/s: round trip shown": [page.evaluate("pebble.connection.socket.roundTripMs")],
    }

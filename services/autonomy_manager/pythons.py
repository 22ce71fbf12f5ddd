"""Finds a Python that has what a script needs: the given one, else the one that runs Pebble, else the system's."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pebble.services.autonomy_manager.describe import DescribeError, answer_of, stamp
from pebble.services.autonomy_manager.needs import DETECT_MARKERS, GSTREAMER, SHMSRC, Needs

SYSTEM = (Path("/usr/bin/python3"), Path("/usr/local/bin/python3"))
_RETRY_S = 60.0  # after an answer that did not come

#: Debian's packages of modules that scripts of robots use. Only these are judged where a script moves its path.
_PACKAGES = {
    "cv2": "python3-opencv",
    GSTREAMER: "python3-opencv",
    DETECT_MARKERS: "python3-opencv",
    SHMSRC: "gstreamer1.0-plugins-bad",
    "paho": "python3-paho-mqtt",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "serial": "python3-serial",
    "yaml": "python3-yaml",
    "gi": "python3-gst-1.0",
    "requests": "python3-requests",
    "PIL": "python3-pil",
}
_ORIGINAL = "it imports `control` of the original's repository, and is no longer inside it: leave it there"

_PROBE = """
import ctypes, importlib.util, json, os, sys
path = list(sys.path)
def has_element(name):
    gst = ctypes.CDLL("libgstreamer-1.0.so.0")
    gst.gst_init(None, None)
    for function in (gst.gst_element_factory_find, gst.gst_registry_get, gst.gst_registry_find_plugin):
        function.restype = ctypes.c_void_p
    gst.gst_plugin_get_filename.restype = ctypes.c_char_p
    core = gst.gst_registry_find_plugin(ctypes.c_void_p(gst.gst_registry_get()), b"coreelements")
    path.append(os.path.dirname(os.fsdecode(gst.gst_plugin_get_filename(ctypes.c_void_p(core)) or b"")))
    return gst.gst_element_factory_find(name)
def lacks(name):
    if name == "OpenCV with GStreamer":
        import cv2
        return not any("GStreamer" in line and "YES" in line for line in cv2.getBuildInformation().splitlines())
    if name == "OpenCV 4's aruco.detectMarkers":
        import cv2
        return not hasattr(cv2.aruco, "detectMarkers")
    if name == "GStreamer's shmsrc":
        return not has_element(b"shmsrc")
    return importlib.util.find_spec(name) is None
def missing(name):
    try:
        return lacks(name)
    except Exception:
        return True
print(json.dumps({"missing": [name for name in sys.argv[1:] if missing(name)], "path": path}))
"""

log = logging.getLogger(__name__)

#: The things among those given that a Python lacks, and the folders of its modules and plugins. Raises DescribeError.
Probe = Callable[[str, Sequence[str], Path, Mapping[str, str]], tuple[list[str], list[str]]]


def probe(
    python: str, things: Sequence[str], folder: Path, variables: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    """Ask ``python`` which of these modules and features it lacks; nothing of the script is run."""
    raw = answer_of((python, "-c", _PROBE, *things), folder, variables)
    try:
        answer = json.loads(raw.strip().rpartition(b"\n")[2])
        return list(answer["missing"]), list(answer["path"])
    except (ValueError, KeyError, TypeError) as error:
        raise DescribeError(f"{python} cannot be asked what it has: {error}") from None


class Pythons:
    """Chooses interpreters, and remembers their answers until the folders of what they use change. For one thread."""

    def __init__(
        self, ask: Probe = probe, system: Sequence[Path] = SYSTEM, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._ask, self._system, self._clock = ask, system, clock
        self._answers: dict[object, tuple[object, float, list[str], list[str]]] = {}

    def choose(
        self, name: str, given: str | None, needs: Needs, folder: Path, variables: Mapping[str, str]
    ) -> tuple[str, str]:
        """The interpreter for the script ``name``, and what is wrong with it; ``given``: its config names one."""
        things = [module for module in needs.modules if module in _PACKAGES or not needs.moves_path]
        things += needs.features
        system = next((str(path) for path in self._system if path.is_file()), sys.executable)
        candidates = [sys.executable, system] if given is None else [given]
        for python in candidates:
            missing = self._lacks(python, things, folder, variables)
            if not missing:
                return python, _ORIGINAL if needs.original else ""
        python = candidates[-1]
        to_install = missing if python == system else self._lacks(system, things, folder, variables)
        packages = dict.fromkeys(_PACKAGES[thing] for thing in to_install if thing in _PACKAGES)
        advice = [f"apt install {' '.join(packages)}"] if packages else []
        if python != system and (packages or not to_install):
            advice.append(f"set scripts.{name}.python to {system}")
        return python, f"{python} lacks {', '.join(missing)}{': ' if advice else ''}{', and '.join(advice)}"

    def _lacks(self, python: str, things: Sequence[str], folder: Path, variables: Mapping[str, str]) -> list[str]:
        """What of these is missing; nothing, where the answer does not come: then the script itself says it."""
        if not things:
            return []
        key = (python, tuple(things), folder, variables.get("PYTHONPATH"))
        known = self._answers.get(key)
        if known is not None and known[0] == _stamps(python, known[3]) and self._clock() < known[1]:
            return known[2]
        try:
            missing, path = self._ask(python, things, folder, variables)
            until = float("inf")
        except DescribeError as error:
            log.debug("%s", error)
            missing, path, until = [], [], self._clock() + _RETRY_S
        self._answers[key] = (_stamps(python, path), until, missing, path)
        return missing


def _stamps(python: str, path: Sequence[str]) -> object:
    """Differs once something was installed there."""
    return [stamp(Path(place)) for place in (python, *path) if place]

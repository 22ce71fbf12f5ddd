"""What a Python script needs besides MQTT, by its text: the file and what it imports beside it. They are never run."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

_MOST_FILES = 32  # of one script
_LONGEST_SOURCE = 1024 * 1024
_PARENTS = 3  # folders above a script from which it may import: the original's import from two above
_PICTURE_OPTION, _SOUND_CAPS = "--video-shm", "audio/x-raw"
_CALIBRATION_OPTION, CALIBRATION = "--calibration", "camera_calibration.yaml"

_ORIGINAL = "control"

HALL_OPTION = "--shm-name"
#: Features of OpenCV and of GStreamer that are checked as modules are; the library of GStreamer is that of OpenCV.
GSTREAMER, DETECT_MARKERS, SHMSRC = "OpenCV with GStreamer", "OpenCV 4's aruco.detectMarkers", "GStreamer's shmsrc"


class Needs(Struct, frozen=True):
    """``modules`` are neither Python's nor beside the script; ``features``: of its OpenCV and GStreamer."""

    modules: tuple[str, ...] = ()
    features: tuple[str, ...] = ()
    pictures: bool = False  # raw ones, at the camera's GStreamer socket
    sound: bool = False  # at the microphone's
    hall: bool = False  # samples in shared memory
    calibration: bool = False  # of the camera, in a file
    moves_path: bool = False  # it changes where Python finds modules
    original: bool = False  # the original's package `control`, and it is not where the script seeks it
    files: tuple[Path, ...] = ()  # that were read


def needs_of(entry: Path) -> Needs:
    """Read ``entry`` and the modules beside it. What is no Python of this version has no known needs."""
    source = _Source(entry.parent)
    waiting = [entry]
    while waiting and len(source.files) < _MOST_FILES:
        file = waiting.pop(0)
        if file not in source.files:
            waiting += source.read(file)
    return source.needs()


class _Source:
    """What the files read so far import and mention."""

    def __init__(self, folder: Path) -> None:
        self._bases = (folder, *folder.parents[:_PARENTS])
        self.files: list[Path] = []
        self._modules: dict[str, None] = {}
        self._imported: set[str] = set()  # also where they may be missing
        self._names: set[str] = set()  # attributes
        self._texts: set[str] = set()

    def read(self, file: Path) -> list[Path]:
        """Take a file in, and return those beside it that it uses."""
        self.files.append(file)
        try:
            if file.stat().st_size > _LONGEST_SOURCE:
                return []
            tree = ast.parse(file.read_bytes())
        except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
            return []
        beside = [found for name in _imports(tree.body) if (found := self._needed(name)) is not None]
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                self._imported.update(name.partition(".")[0] for name in _imports([node]))
            elif isinstance(node, ast.Attribute):
                self._names.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str | bytes):
                text = node.value if isinstance(node.value, str) else node.value.decode("latin-1")
                self._texts.add(text)
                if text.endswith(".py") and "/" not in text:
                    beside.append(file.parent / text)  # run by path
        return [path for path in beside if path.is_file()]

    def _needed(self, module: str) -> Path | None:
        """The file of a module beside the script; else note that it is needed."""
        top = module.partition(".")[0]
        if top in sys.stdlib_module_names:
            return None
        parts = module.split(".")
        for base in self._bases:
            if (base / top).is_dir() or (base / f"{top}.py").is_file():
                file = base.joinpath(*parts)
                return file / "__init__.py" if file.is_dir() else file.with_name(f"{parts[-1]}.py")
        self._modules[top] = None
        return None

    def needs(self) -> Needs:
        texts = self._texts
        sockets = any("shmsrc" in text for text in texts)
        sound = sockets and any(_SOUND_CAPS in text for text in texts)
        pictures = _PICTURE_OPTION in texts or (sockets and not sound)
        opencv = "cv2" in self._imported
        old_aruco = opencv and "detectMarkers" in self._names and not {"ArucoDetector"} & (self._names | texts)
        gstreamer = opencv and ("CAP_GSTREAMER" in self._names or sockets)
        features = {GSTREAMER: gstreamer, DETECT_MARKERS: old_aruco, SHMSRC: sockets}
        moves_path = "path" in self._names and "sys" in self._imported
        elsewhere = any(text.startswith("/") for text in texts) if moves_path else False
        return Needs(
            modules=tuple(name for name in self._modules if name != _ORIGINAL),
            original=_ORIGINAL in self._modules and not elsewhere,
            features=tuple(feature for feature, needed in features.items() if needed),
            pictures=pictures,
            sound=sound,
            hall=HALL_OPTION in texts or "PBODRAW1" in texts,
            calibration=_CALIBRATION_OPTION in texts and CALIBRATION in texts,
            moves_path=moves_path,
            files=tuple(self.files),
        )


def _imports(nodes: list[ast.stmt]) -> Iterator[str]:
    """The modules that these statements import. One in a ``try`` or a function may be missing."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module

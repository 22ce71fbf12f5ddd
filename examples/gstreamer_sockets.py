"""Offers a robot's pictures and sound at the GStreamer sockets where programs of the original Pebble read them.

The config names them, services.av_daemon.video.socket_path and audio.socket_path, and this program, which `pebble up`
starts: "extensions": {"gstreamer_sockets.py": {}}. GStreamer serves them: apt install gstreamer1.0-tools
gstreamer1.0-plugins-base gstreamer1.0-plugins-bad. It ends when GStreamer ends, or frames are not what the config says.
"""

import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from pebble.config import load
from pebble.media.frames import Frame, FrameReader
from pebble.ownership import others_in
from pebble.services.av_daemon.config import AvDaemon
from pebble.transports.segments import SHM


def picture(size: tuple[int, int], frame: Frame) -> bytes:
    """Return rows of BGR, each padded to a multiple of four bytes, as GStreamer needs them."""
    pixels = frame.picture()
    if (sent := pixels.shape[1::-1]) != size:
        sys.exit(f"the camera sends pictures of {sent}, and the config says {size}")
    return np.pad(pixels.reshape(size[1], 3 * size[0]), ((0, 0), (0, -3 * size[0] % 4))).tobytes()


def sound(form: tuple[str, int, int], frame: Frame) -> bytes:
    """Return interleaved samples of 16 bits."""
    if (sent := (frame.info.format, frame.info.rate, frame.info.channels)) != form:
        sys.exit(f"the microphone sends {sent}, and the config says {form}")
    return frame.data.tobytes()


def offer(path: Path, parser: str, reader: FrameReader, data: Callable[[Frame], bytes]) -> None:
    """Pass frames to GStreamer until ``reader`` is closed. Raises OSError when GStreamer has ended."""
    if why := others_in(path.parent):
        sys.exit(f"{path}: {why}")
    if path.is_socket():
        path.unlink()  # of a run that was killed: shmsink would choose another name
    sink = f"shmsink socket-path={path} shm-size={64 << 20} wait-for-connection=false sync=false"
    pipeline = f"fdsrc ! {parser} ! queue leaky=downstream max-size-buffers=10 ! {sink}"
    process = subprocess.Popen(["gst-launch-1.0", "-q", *pipeline.split()], stdin=subprocess.PIPE)
    try:
        with process:
            while (frame := reader.read()) is not None:
                process.stdin.write(data(frame))
                process.stdin.flush()
    finally:
        for leftover in SHM.glob(f"shmpipe.{process.pid:5}.*"):  # GStreamer writes five characters, blanks first
            leftover.unlink()


def main(config_path: str) -> None:
    config = load(Path(config_path))
    video, audio = config.section(AvDaemon).video, config.section(AvDaemon).audio
    size = (video.height, video.width) if video.rotate_degrees in (90, 270) else (video.width, video.height)
    bgr = "rawvideoparse format=bgr width={} height={} framerate={}/1".format(*size, round(video.fps))
    pcm = f"rawaudioparse pcm-format=s16le sample-rate={audio.rate} num-channels={audio.channels}"
    form = ("s16le", audio.rate, audio.channels)
    camera, microphone = FrameReader(config.run_dir(), "camera"), FrameReader(config.run_dir(), "microphone", depth=10)
    kinds = {"video": (bgr, camera, partial(picture, size)), "audio": (pcm, microphone, partial(sound, form))}
    with ThreadPoolExecutor() as pool, ExitStack() as readers:
        signal.signal(signal.SIGTERM, lambda *_: readers.close())
        running = []
        for name, path in config.section(AvDaemon).sockets().items():
            parser, reader, data = kinds[name]
            running.append(pool.submit(offer, path, parser, readers.enter_context(reader), data))
        for ended in as_completed(running):
            ended.result()


if __name__ == "__main__":
    main(sys.argv[1])

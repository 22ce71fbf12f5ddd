"""Frames: pictures and sound from one writer to many readers on the same machine, through shared memory.

A robot's streams are `camera` and `microphone`. docs/ext/media.md follows one; decision 7 has the reasons.
"""

from pebble.extensions.media.frames.frame import Frame as Frame
from pebble.extensions.media.frames.frame import FrameInfo as FrameInfo
from pebble.extensions.media.frames.reader import FrameReader as FrameReader
from pebble.extensions.media.frames.writer import FrameWriter as FrameWriter
from pebble.extensions.media.frames.writer import Slot as Slot

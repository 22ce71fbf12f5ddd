"""Frames: pictures and sound from one writer to many readers on the same machine, through shared memory.

A robot's streams are `camera` and `microphone`. docs/life-of-a-frame.md follows one; decision 7 says why it is so.
"""

from pebble.transports.frame import Frame as Frame
from pebble.transports.frame_info import FrameInfo as FrameInfo
from pebble.transports.frame_reader import FrameReader as FrameReader
from pebble.transports.frame_writer import FrameWriter as FrameWriter
from pebble.transports.frame_writer import Slot as Slot
from pebble.transports.segments import sweep as sweep

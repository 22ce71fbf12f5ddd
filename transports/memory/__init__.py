"""The in-process transport."""

from pebble.transports.memory.transport import MemoryHub as MemoryHub
from pebble.transports.memory.transport import MemoryTransport as MemoryTransport

"""The base of every service, under its public name: `from pebble.service import Service, every, on`."""

from pebble.runtime.service import Service as Service
from pebble.runtime.service import every as every
from pebble.runtime.service import on as on

"""The real announcer with a transport that writes to a file: ``fake_announcer RECORD [option…]``.

Options: ``hangs`` (the transport never opens), ``broken`` (it cannot be set up).
"""

from __future__ import annotations

import sys
from pathlib import Path

from pebble.errors import TransportError
from pebble.launcher import announcer
from pebble.runtime.parent import set_up_logging
from pebble.transports import Message, Transport
from tests.fakes.recording_transport import RecordingTransport


def make_transport(will: Message) -> Transport:
    record, *options = sys.argv[1:]
    if "broken" in options:
        raise TransportError("no such certificate")
    return RecordingTransport("launcher", Path(record), will=will, hangs="hangs" in options)


if __name__ == "__main__":
    set_up_logging("INFO")
    sys.exit(announcer.run(make_transport))

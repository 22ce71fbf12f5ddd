"""What one would have without the recorder: ``python -m tests.recordings.plain_logger PORT``.

A paho subscriber to everything that writes a line of JSON for each message, in the fields of the original's logger, to
nowhere: no disk is measured with it. It neither compresses, nor checks, nor makes anything durable. A broker with
Nagle's algorithm sends it several messages at once, up to 40 ms late; to the recorder, which acknowledges TCP's at
once, it sends each when it comes: three times as many wake-ups, and stamps that are right.
"""

from __future__ import annotations

import base64
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion


def main() -> None:
    with Path(os.devnull).open("w") as out:
        client = Client(CallbackAPIVersion.VERSION2)

        def write(_client: Client, _data: Any, message: MQTTMessage) -> None:
            line = {
                "timestamp": time.time(),
                "topic": message.topic,
                "qos": message.qos,
                "retain": message.retain,
                "payload_size_bytes": len(message.payload),
            }
            try:
                line["payload"] = message.payload.decode()
            except UnicodeDecodeError:
                line["payload_base64"] = base64.b64encode(message.payload).decode()
            out.write(json.dumps(line) + "\n")

        client.on_message = write
        client.on_connect = lambda *_: client.subscribe("#", 1)
        client.connect("127.0.0.1", int(sys.argv[1]))
        client.loop_forever()


if __name__ == "__main__":
    main()

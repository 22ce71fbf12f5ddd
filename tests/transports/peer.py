"""The program behind `ProcessPeer`: one client that follows the commands in lines of JSON on stdin."""

from __future__ import annotations

import base64
import json
import pickle
import sys

from pebble.transports import Message, QoS, State, create


def main(recipe: str) -> None:
    kind, name, settings, will = pickle.loads(base64.b64decode(recipe))
    client, received = create(kind, name, settings, will=will).open(10), list[Message]()
    report(client.state is State.CONNECTED)
    for line in sys.stdin:
        request = json.loads(line)
        if "close" in request:
            client.close()
            report(True)
            return
        if "listen" in request:
            client.subscribe("#", received.append)
            report(True)
        elif "heard" in request:
            report([len(received), received[-1].payload.decode() if received else ""])
        else:
            payload = bytes.fromhex(request["payload"])
            report(client.publish(request["topic"], payload, qos=QoS(request["qos"]), retain=request["retain"]))


def report(answer: object) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1])

"""A page server with one page, without a browser, that shows a robot and no pictures: what does looking on cost?

As a process: ``python -m pebble.bench.impair.watcher HOST PORT BASE``. It answers when the robot is shown.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from typing import Final

from pebble.client.page.settings import WebSettings
from pebble.rig.worker_end import answer, serve_on_thread
from pebble.transports import MqttSettings

_START_S: Final = 20.0
_POLL_S = 0.05


def main(host: str, port: str, base: str) -> None:
    import uvicorn
    from websockets.sync.client import connect

    from pebble.web.access.connections import Loop
    from pebble.web.serve import listen, server_config

    ended = serve_on_thread(lambda _line: None)
    settings = WebSettings(broker=MqttSettings(host=host, port=int(port)), port=0, server="trial")
    listener = listen(settings)
    where = f"127.0.0.1:{listener.getsockname()[1]}"
    server = uvicorn.Server(server_config(settings, listener))

    def run() -> None:
        with asyncio.Runner(loop_factory=Loop) as runner:
            runner.run(server.serve(sockets=[listener]))

    threading.Thread(target=run, daemon=True).start()
    until = time.monotonic() + _START_S
    while not server.started and time.monotonic() < until:
        time.sleep(_POLL_S)
    version, shown = server.config.app.state.version, False  # type: ignore[union-attr]
    with connect(f"ws://{where}/ws/control", origin=f"http://{where}", max_size=None) as page:  # type: ignore[arg-type]
        page.send(json.dumps({"op": "hello", "version": version, "device": "trial", "name": "", "token": ""}))
        page.send(json.dumps({"op": "watch", "ref": base, "series": False}))
        while not ended.is_set():
            message = json.loads(page.recv())
            if message["op"] == "ping":
                page.send(json.dumps({"op": "echo", "n": message["n"], "t": 1000 * time.monotonic()}))
            if message["op"] == "state" and not shown and any(ref == base for ref, *_ in message["set"]):
                shown = True
                answer({"shown": True})


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Random seeks on the replay page, in a recording of an hour: ``python -m tests.ext.page.replay_seeks``.

For each encoding: how long from the seek to the drawn picture, whether it is the right one, and what the page and the
server remember of all that. Nothing may be published, and the page may send nothing but what every page sends.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, CDPSession

from pebble.extensions.lab.bench.results import percentile
from pebble.extensions.lab.bench.usage import pss_mb
from tests.ext.page import rig
from tests.ext.page.browser import Tab, tab
from tests.ext.page.page_soak import memory
from tests.ext.page.served import Served
from tests.ext.recordings.playing import GOOB, ms
from tests.ext.recordings.recorder.test_record import Reference
from tests.ext.recordings.seek.filming import FPS, film
from tests.support import Broker

ENCODINGS = ("json", "pbvd", "h264")
SIZE = (640, 480)
_MINUTE_S = 60
#: Resolves with milliseconds until a picture was drawn, and when that was received.
_SEEK = """(at) => new Promise((resolve) => {
  const { replay } = window.pebble;
  const began = performance.now();
  replay.seek(at);
  const look = () => {
    const { info } = replay.video;
    if (!replay.feed.seeking && info) resolve([performance.now() - began, info.receivedMs]);
    else if (performance.now() - began > 10000) resolve([Infinity, 0]);
    else setTimeout(look, 1);
  };
  look();
})"""
#: Notes what the page sends.
_SENT = """(() => {
  const send = WebSocket.prototype.send;
  window.sent = [];
  WebSocket.prototype.send = function (data) {
    window.sent.push(String(data).slice(0, 40));
    return send.call(this, data);
  };
})();"""


def seek(opened: Tab, at_ms: float) -> tuple[float, float]:
    took, received = opened.page.evaluate(_SEEK, at_ms)
    return float("inf") if took is None else float(took), float(received)


def renderers_mb(browser: CDPSession) -> float:
    processes = browser.send("SystemInfo.getProcessInfo")["processInfo"]
    return float(sum(pss_mb(one["id"]) for one in processes if one["type"] == "renderer"))


def measure(browser: Browser, broker: Broker, encoding: str, seconds: float, seeks: int) -> dict[str, Any]:
    chance, session = random.Random(5), browser.new_browser_cdp_session()
    with tempfile.TemporaryDirectory() as folder:
        root = film(Path(folder), encoding, seconds, SIZE, times=max(1, int(seconds / _MINUTE_S)), interval=None)
        with Served(broker.port, recordings=root) as served:
            url = f"{served.origin}/replay/{GOOB}?at={ms(10):.0f}"
            with tab(browser, url, script=_SENT) as opened:
                assert opened.until("Boolean(window.pebble?.replay?.video.info)", 60), opened.complaints()
                took, wrong, memories = [], 0, []
                for number in range(seeks):
                    at = ms(chance.uniform(5, seconds - 5))
                    one, received = seek(opened, at)
                    took.append(one)
                    wrong += not at - 2500 / FPS <= received <= at + 1
                    opened.page.wait_for_timeout(30)
                    if number % max(1, seeks // 10) == 0:
                        memories.append((memory(opened)["heap"], renderers_mb(session)))
                sent = {text.split(",")[0] for text in opened.page.evaluate("window.sent")}
                return {"took": took, "wrong": wrong, "memories": memories, "sent": sent, "bad": opened.complaints()}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.ext.page.replay_seeks", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the recording")
    parser.add_argument("--seeks", type=int, default=200)
    options = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as folder, rig.chromium() as browser:
        broker = Broker(Path(folder))
        reference = Reference(broker.port)
        for encoding in ENCODINGS:
            found = measure(browser, broker, encoding, options.seconds, options.seeks)
            took, memories = found["took"], found["memories"]
            heaps, all_of = ([one[place] for one in memories] for place in (0, 1))
            sys.stdout.write(
                f"{encoding}: to the drawn picture p50 {percentile(took, 50):.0f} p95 {percentile(took, 95):.0f} "
                f"max {max(took):.0f} ms of {len(took)}, {found['wrong']} wrong; heap {heaps[1]:.1f} to {heaps[-1]:.1f}"
                f" MB, renderers {all_of[1]:.0f} to {all_of[-1]:.0f} MB; sent: {', '.join(sorted(found['sent']))}\n"
            )
            sys.stdout.writelines(f"  {line}\n" for line in found["bad"])
            sys.stdout.flush()
            bad += found["wrong"] + len(found["bad"])
        published = {message.topic for message in reference.received if "/robots/" in message.topic}
        sys.stdout.write(f"published below robots: {', '.join(sorted(published)) or 'nothing'}\n")
        reference.transport.close()
        broker.stop()
    return 1 if bad or published else 0


if __name__ == "__main__":
    sys.exit(main())

"""A fake arecord: the synthetic voice on stdout as raw s16le. ``FAKE=hangs`` stops after a second."""

from __future__ import annotations

import argparse
import os
import sys
import time
from itertools import count

from pebble.extensions.media.speech import Speech
from tests.fakes.installed import signed_in


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("rate", "channels", "period-time"):
        parser.add_argument(f"--{name}", type=int, required=True)
    options, _others = parser.parse_known_args()
    speech, period_s = Speech(options.rate, options.channels), options.period_time / 1e6
    begin, size = time.monotonic(), round(options.rate * period_s)
    for number in count():
        if os.environ.get("FAKE") == "hangs" and number == 50:
            time.sleep(1000)
        time.sleep(max(0.0, begin + (number + 1) * period_s - time.monotonic()))
        sys.stdout.buffer.write(speech.samples(number * size, size).tobytes())
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    signed_in()
    main()

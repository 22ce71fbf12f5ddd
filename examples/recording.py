"""Counts the messages of a recording by topic, with the reader of MCAP's makers: python recording.py FILE.mcap"""

import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

if __name__ == "__main__":
    counts: Counter[str] = Counter()
    with Path(sys.argv[1]).open("rb") as file:
        for _schema, channel, _message in make_reader(file).iter_messages():
            counts[channel.topic] += 1
    for topic, count in counts.most_common():
        print(f"{count:8} {topic}")

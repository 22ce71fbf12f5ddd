"""How often messages come and how large they are, over a window of the newest."""

from __future__ import annotations

import statistics
from collections import deque
from itertools import pairwise

from pebble.commands.show import size


class Rates:
    """Arrival times (monotonic seconds) and sizes of up to ``window`` messages."""

    def __init__(self, window: int) -> None:
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=window + 1)
        self.count = 0

    def add(self, arrived: float, size: int) -> None:
        self._arrivals.append((arrived, size))
        self.count += 1

    @property
    def hz(self) -> float | None:
        """Messages per second between the first and the last of the window; None before the second."""
        span = self._arrivals[-1][0] - self._arrivals[0][0] if self._arrivals else 0.0
        return (len(self._arrivals) - 1) / span if span > 0 else None

    def frequency_line(self) -> str | None:
        """As ``ros2 topic hz`` says it; None before the second message."""
        if self.hz is None:
            return None
        gaps = [later[0] - earlier[0] for earlier, later in pairwise(self._arrivals)]
        spread = statistics.pstdev(gaps)
        limits = f"min {min(gaps):.4f} s  max {max(gaps):.4f} s"
        return f"{self.hz:.3f} Hz  {limits}  std dev {spread:.5f} s  window {len(gaps)}"

    def bandwidth_line(self) -> str | None:
        """As ``ros2 topic bw`` says it; None before the second message."""
        if self.hz is None:
            return None
        sizes = [length for _, length in self._arrivals]
        mean = statistics.fmean(sizes)
        return (
            f"{size(mean * self.hz)}/s ({mean * self.hz * 8 / 1000:.1f} kbit/s)  mean {size(mean)}  "
            f"min {size(min(sizes))}  max {size(max(sizes))}  window {len(sizes)}"
        )

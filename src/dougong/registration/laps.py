"""Seconds per step of a registration."""

import time
from dataclasses import dataclass, field


@dataclass(slots=True)
class Laps:
    """Seconds per step."""

    seconds: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        """Add the seconds since the last lap to step `name`."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now

"""How long the neural networks of this process were at work."""

from __future__ import annotations

import threading
import time

__all__ = ["NETWORK_CLOCK", "BusyClock"]


class BusyClock:
    """Adds up the time during which at least one thread is inside.

    Work that runs side by side counts once, so the total never exceeds the time that passed.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n_inside = 0
        self._since_s = 0.0
        self.total_s = 0.0

    def __enter__(self) -> None:
        with self._lock:
            if self._n_inside == 0:
                self._since_s = time.perf_counter()
            self._n_inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._n_inside -= 1
            if self._n_inside == 0:
                self.total_s += time.perf_counter() - self._since_s


NETWORK_CLOCK = BusyClock()
"""Runs while any network of this process does, whoever started it."""

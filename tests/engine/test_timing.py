import threading
import time

import pytest

from engine.timing import BusyClock


def test_work_side_by_side_counts_once():
    clock, together = BusyClock(), threading.Barrier(2)

    def work():
        with clock:
            together.wait()
            time.sleep(0.05)

    start = time.perf_counter()
    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert 0.05 <= clock.total_s <= time.perf_counter() - start


def test_an_error_inside_stops_the_clock():
    clock = BusyClock()
    with pytest.raises(ValueError), clock:
        raise ValueError
    total = clock.total_s
    time.sleep(0.01)
    assert clock.total_s == total

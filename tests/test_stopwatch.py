"""Calls are timed warm, in turns, by the processor's clock."""

import os
import time

import numpy as np
import pytest

from jaxctrl import stopwatch
from jaxctrl.stopwatch import Taken


def test_calls_are_timed_in_turns_and_none_for_the_first_time():
    made = []

    def lasting(name, seconds):
        # It says itself what it takes, so that no clock is asked.
        return lambda count: made.append((name, count)) or Taken(seconds, 2 * seconds)

    found = stopwatch.in_turns([lasting("slow", 0.02), lasting("fast", 0.001)], 3)
    first = [("slow", 1)] * 2 + [("fast", 1)] * 4
    turn = [("slow", 1), ("slow", 1), ("fast", 1), ("fast", 5)]
    assert made == first + turn * 3
    assert found.cpu == pytest.approx(np.tile([0.02, 0.001], (3, 1)))
    assert found.wall == pytest.approx(2 * found.cpu)


def test_a_call_that_waits_takes_wall_time_and_no_processor_time():
    taken = stopwatch.take(lambda count: time.sleep(0.05 * count), 2)
    assert taken.cpu < 0.02 and 0.05 <= taken.wall < 1


def test_a_call_that_computes_takes_both():
    def compute():
        start = time.process_time()
        while time.process_time() < start + 0.02:
            pass

    taken = stopwatch.take(stopwatch.repeated(compute), 3)
    assert 0.02 <= taken.cpu < 0.03 and taken.wall > 0.99 * taken.cpu


def test_what_is_quick_is_repeated_and_what_is_slow_is_not():
    assert stopwatch.count_for(lambda count: Taken(1e-4, 1e-4), 5e-3) == 50
    assert stopwatch.count_for(lambda count: Taken(1.0, 1.0), 5e-3) == 1


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system cannot pin")
def test_one_core_is_left_again_also_after_an_error():
    with pytest.raises(KeyError), stopwatch.one_core():
        assert len(os.sched_getaffinity(0)) == 1
        raise KeyError
    assert os.sched_getaffinity(0) == set(stopwatch.CORES)

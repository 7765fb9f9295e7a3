"""The buffer of sets to learn from: what ends with it, and which continuations it refuses."""

import multiprocessing
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from threading import Thread

import numpy as np
import pytest
from helpers.processes import wait_until
from tiny import TINY_PLANS

from train.buffer import Buffer

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

KEYS = ("cities", "agents", "visited", "action_mask")


def test_sets_that_come_out_shorter_than_they_were_are_refused():
    """As by another version of the code."""
    buffer = Buffer(replace(TINY_PLANS, workers=0), KEYS, np.random.default_rng(0))
    buffer.add(0)
    state = buffer.state_dict()
    state["left"] = [[*state["left"][0], 100]]
    with pytest.raises(ValueError, match=r"set 0 of the run had at least 101 decision indices, now it has"):
        buffer.load_state_dict(state)


@pytest.mark.slow
def test_to_close_a_buffer_does_not_wait_for_the_sets_under_way():
    """Which would take days here. Other children of the process go on."""
    spawn = multiprocessing.get_context("spawn")
    ends = spawn.Event()
    other = spawn.Process(target=ends.wait, daemon=True)
    other.start()
    buffer = Buffer(replace(TINY_PLANS, workers=2, teacher_iterations=10**9), KEYS, np.random.default_rng(0))
    failed = []

    def draw():
        with pytest.raises(BrokenProcessPool):
            buffer.draw(2)
        failed.append(True)

    Thread(target=draw, daemon=True).start()
    wait_until(lambda: len(multiprocessing.active_children()) == 3)
    Thread(target=buffer.close, daemon=True).start()
    wait_until(lambda: failed and multiprocessing.active_children() == [other])
    ends.set()
    other.join()

"""Fixtures for all tests: a square solved by hand, and a folder with its files. Pictures never open a window."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

os.environ["MPLBACKEND"] = "Agg"  # before anything imports matplotlib

import pytest
from hypothesis import HealthCheck, settings

from mtsp_env import Instance, write_instance

# Some tests send signals that are ignored if a shell (SIGINT) or nohup (SIGHUP) has started them in the background.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, handler)

# For `make fuzz`. Tests in tests/fuzz say nothing about max_examples, so that a profile decides: by default 100.
settings.register_profile("fuzz", max_examples=10_000, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """What a command does on Ctrl-C and SIGTERM ends with the test that ran it in this process."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def square() -> Instance:
    """The depot in the middle of the unit square, two agents, each with a quarter of the square to go round.

        1 - 2 ---- .        0: depot (0.5, 0.5)
        |   |      |        1 to 3: the corner (0, 1) and the middles of its sides
        3 - 0 ---- 6        4 to 6: the corner (1, 0) and the middles of its sides
        |   |      |
        . - 4 ---- 5

    The optimum is 2: an agent that visits both corners goes at least 2 sqrt(2), so each takes one; an agent with four
    cities goes at least 2.5 as every leg is at least 0.5, so each takes three; and four legs are at least 2.
    """
    nodes = [[0.5, 0.5], [0.0, 1.0], [0.5, 1.0], [0.0, 0.5], [0.5, 0.0], [1.0, 0.0], [1.0, 0.5]]
    return Instance(nodes, n_agents=2, name="square")


@pytest.fixture
def square_tours() -> list[list[int]]:
    """Tours that solve ``square``: both of length 2."""
    return [[0, 2, 1, 3, 0], [0, 4, 5, 6, 0]]


@pytest.fixture
def folder(tmp_path, monkeypatch, square: Instance) -> Path:
    """The working directory, with the square in it in two formats."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    write_instance("square.json", square)
    rows = "".join(f"{k} {10 * x} {10 * y}\n" for k, (x, y) in enumerate(square.nodes, 1))
    Path("ten.tsp").write_text(f"NAME: ten\nDIMENSION: 7\nEDGE_WEIGHT_TYPE: EUC_2D\nNODE_COORD_SECTION\n{rows}EOF\n")
    return tmp_path

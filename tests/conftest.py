"""What every test may ask for: a square solved by hand. Pictures never open a window."""

import os

os.environ["MPLBACKEND"] = "Agg"  # before anything imports matplotlib

import pytest

from mtsp_env import Instance


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

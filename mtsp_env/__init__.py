"""The MinMax multiple travelling salesman problem as a multi-agent environment.

>>> from mtsp_env import mtsp_v0
>>> env = mtsp_v0.env(n_nodes=50, n_agents=5)

Importing this package needs only NumPy, Gymnasium and PettingZoo; the batched TorchRL environment is in
``mtsp_env.batched``. It also registers the single-agent view, ``gymnasium.make("mtsp/MinMaxMTSP-v0")``.
"""

from mtsp_env.distributions import DISTRIBUTIONS, SCENARIOS, clustered, uniform
from mtsp_env.files import read_instance, read_tours, write_instance, write_tours
from mtsp_env.instance import Instance, from_coordinates
from mtsp_env.tours import check_log, check_tours, lower_bound, makespan, tour_lengths
from mtsp_env.tsplib import read_tsplib
from mtsp_env.version import __version__

__all__ = [
    "DISTRIBUTIONS",
    "SCENARIOS",
    "Instance",
    "__version__",
    "check_log",
    "check_tours",
    "clustered",
    "from_coordinates",
    "lower_bound",
    "makespan",
    "read_instance",
    "read_tours",
    "read_tsplib",
    "tour_lengths",
    "uniform",
    "write_instance",
    "write_tours",
]


def _register() -> None:
    """Name the environments for ``gymnasium.make`` and, if this PettingZoo has it (1.27 on), ``pettingzoo.make``."""
    import gymnasium

    gymnasium.register("mtsp/MinMaxMTSP-v0", entry_point="mtsp_env.single:MinMaxMTSP")
    try:
        from pettingzoo import register
    except (ImportError, FileNotFoundError):  # it cannot be imported in a working directory that is gone
        return
    register("aec", "mtsp/mtsp-v0", entry_point="mtsp_env.mtsp_v0:env")


_register()

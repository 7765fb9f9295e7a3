"""Made-up results for the tests of the benchmarks."""

from __future__ import annotations

from typing import Any

from benchmarks.harness.rows import Row
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import makespan


def one_agent_does_it_all(instance: Instance) -> Tours:
    """Tours in which agent 0 visits every city, in the order of their numbers, and the others stay at home."""
    return [[0, *range(1, instance.n_nodes), 0]] + [[0, 0]] * (instance.n_agents - 1)


def row(instance: Instance, tours: Tours, number: int, cell: str = "8x2", table: str = "smoke", **more: Any) -> Row:
    """A row of results with these tours and one second; ``more`` replaces its fields."""
    fields = {name: None for name in Row.__dataclass_fields__} | {
        "table": table,
        "cell": cell,
        "instance": number,
        "name": instance.name,
        "seed": 7,
        "status": "ok",
        "method": "deals",
        "seconds": 1.0,
        "tours": tours,
        "makespan": makespan(instance, tours),
        "versions": {},
        "machine": {},
    }
    return Row(**(fields | more))

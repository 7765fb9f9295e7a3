"""Test sets: fixed instances that nothing is ever trained or tuned on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtsp_env.instance import Instance, sample_nodes


@dataclass(frozen=True)
class Cell:
    """Instances of one size: ``count`` of them, drawn by (seed, n, m) alone."""

    n_nodes: int
    n_agents: int
    count: int

    def instances(self, seed: int, distribution: str = "uniform") -> list[Instance]:
        """The cell's instances; the first k are the same whatever ``count`` is."""
        rng = np.random.default_rng([seed, self.n_nodes, self.n_agents])
        return [
            Instance(sample_nodes(distribution, rng, 1, self.n_nodes)[0], self.n_agents, f"{self.label}-{i}")
            for i in range(self.count)
        ]

    @property
    def label(self) -> str:
        """For example "50x5": n = 50, m = 5."""
        return f"{self.n_nodes}x{self.n_agents}"


SETS: dict[str, tuple[Cell, ...]] = {
    "smoke": (Cell(8, 2, 3),),
    "first": (Cell(20, 3, 25), Cell(30, 5, 25), Cell(50, 5, 25), Cell(100, 10, 25)),
}
SEED = 7  # of the published results


def cells(name: str) -> tuple[Cell, ...]:
    """The cells of a named set. Raises ValueError where there is no such set."""
    if name not in SETS:
        raise ValueError(f"unknown set {name!r}; choose from {sorted(SETS)}")
    return SETS[name]

"""The optimum of tiny instances: ``exact`` proves it, dynamic programming confirms it, and other solvers reach it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from benchmarks.files import write_text
from benchmarks.reports.markdown import markdown_table
from benchmarks.solvers import SOLVERS, exact, lkh3, reference
from benchmarks.suite import SEED, Cell
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance
from mtsp_env.tours import check_tours, makespan

REPORT = Path(__file__).parents[1] / "results" / "exact.md"
CELLS = tuple(
    Cell(n, m, 2) for n, m in [(6, 2), (7, 3), (8, 2), (8, 3), (10, 2), (10, 3), (11, 4), (12, 2), (12, 3), (12, 4)]
)
EQUAL = 1e-6  # relative tolerance: LKH rounds lengths, HiGHS has tolerances
PROOF_SECONDS, REFERENCE_SECONDS, LKH_SECONDS = 600.0, 0.1, 5.0  # at most
MAX_NODES = 13  # 3^(n-1) steps for each agent take seconds


def optimal_makespan(instance: Instance) -> float:
    """The optimum by dynamic programming: the shortest tour of each set of cities (Held and Karp 1962), then the sets.

    Raises:
        ValueError: more than MAX_NODES nodes.
    """
    if instance.n_nodes > MAX_NODES:
        raise ValueError(f"n_nodes must be at most {MAX_NODES}, got {instance.n_nodes}")
    tour = _shortest_tours(np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2))
    best = list(tour)  # of each set, a bit mask, for the agents so far
    for _ in range(min(instance.n_agents, instance.n_nodes - 1) - 1):
        best = [min(max(tour[part], best[cities ^ part]) for part in _subsets(cities)) for cities in range(len(tour))]
    return best[-1]


def _subsets(cities: int) -> list[int]:
    """Every subset of a set, the empty set and the set itself included."""
    subsets, subset = [0], cities
    while subset:
        subsets.append(subset)
        subset = (subset - 1) & cities
    return subsets


def _shortest_tours(distance: np.ndarray) -> list[float]:
    """For each set of cities, the length of the shortest tour from the depot through it."""
    n = len(distance) - 1
    home, between = distance[0, 1:].tolist(), distance[1:, 1:].tolist()
    path = [[math.inf] * n for _ in range(1 << n)]  # the shortest from the depot through a set, ending at a city of it
    tour = [0.0] * (1 << n)
    for cities in range(1, 1 << n):
        members = [city for city in range(n) if cities >> city & 1]
        for last in members:
            before = cities ^ (1 << last)
            onward = (path[before][city] + between[city][last] for city in members if city != last)
            path[cities][last] = min(onward) if before else home[last]
        tour[cities] = min(path[cities][last] + home[last] for last in members)
    return tour


@dataclass(frozen=True)
class Optimum:
    """The optimum of an instance and the makespans of the solvers.

    Attributes:
        label: name of the instance, such as "12x3-0".
        proof: proof by ``exact``.
        seconds: CPU time of the proof.
        optimum: makespan by dynamic programming.
        reference: makespan of the reference solver.
        lkh3: makespan of LKH-3.
    """

    label: str
    proof: exact.Proof
    seconds: float
    optimum: float
    reference: float
    lkh3: float

    @property
    def confirmed(self) -> bool:
        """Whether the optimum is proved and all makespans agree with it."""
        return self.proof.optimal and all(map(self.is_optimal, (self.proof.makespan, self.reference, self.lkh3)))

    def is_optimal(self, makespan: float) -> bool:
        """Whether a makespan is the optimum, within EQUAL."""
        return abs(makespan - self.optimum) <= EQUAL * self.optimum


def find_optima(count: int = 20, backend: str = "highs", seed: int = SEED) -> list[Optimum]:
    """Prove, confirm and search for the optimum of the first ``count`` instances of CELLS.

    Raises:
        ValueError: ``count`` is not from 1 to 20, or the backend is unknown.
        Unavailable: a solver is missing.
    """
    check_count("count", count, minimum=1)
    instances = [instance for cell in CELLS for instance in cell.instances(seed)]
    if count > len(instances):
        raise ValueError(f"count must be 1 to {len(instances)}, got {count}")
    return [_find_optimum(instance, backend, seed) for instance in track(instances[:count], description="proofs")]


def _find_optimum(instance: Instance, backend: str, seed: int) -> Optimum:
    start = time.process_time()
    proof = exact.prove(instance, PROOF_SECONDS, seed, backend)
    seconds = time.process_time() - start
    tours = [reference.solve(instance, REFERENCE_SECONDS, seed), lkh3.solve(instance, LKH_SECONDS, seed)]
    for one in (proof.tours, *tours):
        check_tours(instance, one)
    costs = [makespan(instance, one) for one in tours]
    return Optimum(instance.name, proof, seconds, optimal_makespan(instance), *costs)


def to_markdown(optima: list[Optimum]) -> str:
    """A table with a line for each instance."""
    heads = [
        "instance (n x m)",
        "exact: makespan",
        "bound",
        "proved",
        "CPU s",
        "dynamic programming",
        "reference",
        "lkh3",
    ]
    lines = [
        [
            one.label,
            f"{one.proof.makespan:.6f}",
            f"{one.proof.bound:.6f}",
            "yes" if one.proof.optimal else f"gap {100 * one.proof.gap:.2f} %",
            f"{one.seconds:.1f}",
            f"{one.optimum:.6f}",
            *("reached" if one.is_optimal(cost) else f"{cost:.6f}" for cost in (one.reference, one.lkh3)),
        ]
        for one in optima
    ]
    return markdown_table(heads, lines)


def main(out: Path = REPORT) -> None:
    """Prove and confirm the optimum of 20 tiny instances; print a table and write it to a file.

    Args:
        out: file for the table in Markdown.

    Raises:
        Unavailable: a solver is missing.
    """
    optima = find_optima()
    versions = {k: v for name in ("exact", "reference", "lkh3") for k, v in SOLVERS[name].versions().items()}
    text = f"""# Optima of tiny instances

`python -m benchmarks optima`: uniform instances of seed {SEED}; one thread;
{", ".join(f"{package} {version}" for package, version in versions.items())}.

"Dynamic programming" is the optimum over all sets of cities; for n <= 8 the tests confirm it by enumeration. Proved:
the bound is within {exact.PROVED:g} of the makespan. Reached: within {EQUAL:g} of the optimum, by the reference solver
in {REFERENCE_SECONDS:g} s, by LKH in {LKH_SECONDS:g} s at most.

All of this holds for {sum(one.confirmed for one in optima)} of {len(optima)} instances.

{to_markdown(optima)}
"""
    write_text(out, text)
    print(text)

"""The optimum of tiny instances: ``exact`` proves it, a search through all sets confirms it, other solvers reach it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from benchmarks.files import replace_text
from benchmarks.solvers import SOLVERS, exact, lkh3, reference
from benchmarks.suite import SEED, Cell
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance
from mtsp_env.tours import check_tours, makespan

REPORT = Path(__file__).parents[1] / "results" / "exact.md"
CELLS = tuple(
    Cell(n, m, 2) for n, m in [(6, 2), (7, 3), (8, 2), (8, 3), (10, 2), (10, 3), (11, 4), (12, 2), (12, 3), (12, 4)]
)
EQUAL = 1e-6  # relative: LKH rounds lengths, HiGHS has tolerances
PROOF_SECONDS, REFERENCE_SECONDS, LKH_SECONDS = 600.0, 0.1, 5.0  # at most
MAX_NODES = 13  # 3^(n-1) steps for each agent: seconds


def by_subsets(instance: Instance) -> float:
    """The least makespan: the shortest tour of each set of cities (Held and Karp 1962), then the best sets.

    Raises:
        ValueError: more than MAX_NODES nodes.
    """
    if instance.n_nodes > MAX_NODES:
        raise ValueError(f"n_nodes must be at most {MAX_NODES}, got {instance.n_nodes}")
    tour = _shortest_tours(np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2))
    best = list(tour)  # of each set, for the agents so far; sets are bit masks
    for _ in range(min(instance.n_agents, instance.n_nodes - 1) - 1):
        best = [min(max(tour[part], best[cities ^ part]) for part in _parts(cities)) for cities in range(len(tour))]
    return best[-1]


def _parts(cities: int) -> list[int]:
    """Every subset, the empty one and the whole included."""
    parts, part = [0], cities
    while part:
        parts.append(part)
        part = (part - 1) & cities
    return parts


def _shortest_tours(distance: np.ndarray) -> list[float]:
    """Of each set of cities, the length of the shortest tour from the depot through it."""
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
class Checked:
    """Makespans found for an instance, and how long the proof took.

    Attributes:
        label: for example "12x3-0".
        seconds: of processor time for the proof.
    """

    label: str
    proof: exact.Proof
    seconds: float
    by_subsets: float
    reference: float
    lkh3: float

    @property
    def holds(self) -> bool:
        """Proved, and all agree."""
        return self.proof.optimal and all(map(self.reached, (self.proof.makespan, self.reference, self.lkh3)))

    def reached(self, makespan: float) -> bool:
        """It is the optimum, but for EQUAL."""
        return abs(makespan - self.by_subsets) <= EQUAL * self.by_subsets


def check(count: int = 20, backend: str = "highs", seed: int = SEED) -> list[Checked]:
    """Prove, confirm and search for the optimum of the first ``count`` instances of CELLS.

    Raises:
        ValueError: count is not 1 to 20, or an unknown backend.
        Unavailable: a solver is missing.
    """
    check_count("count", count, minimum=1)
    instances = [instance for cell in CELLS for instance in cell.instances(seed)]
    if count > len(instances):
        raise ValueError(f"count must be 1 to {len(instances)}, got {count}")
    return [_check(instance, backend, seed) for instance in track(instances[:count], description="proofs")]


def _check(instance: Instance, backend: str, seed: int) -> Checked:
    started = time.process_time()
    proof = exact.prove(instance, PROOF_SECONDS, seed, backend)
    seconds = time.process_time() - started
    searched = reference.solve(instance, REFERENCE_SECONDS, seed), lkh3.solve(instance, LKH_SECONDS, seed)
    for tours in (proof.tours, *searched):
        check_tours(instance, tours)
    return Checked(instance.name, proof, seconds, by_subsets(instance), *(makespan(instance, t) for t in searched))


def markdown(rows: list[Checked]) -> str:
    """A row for each instance."""
    lines = [
        "| instance (n x m) | exact: makespan | bound | proved | cpu s | all sets | reference | lkh3 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        proved = "yes" if row.proof.optimal else f"gap {100 * row.proof.gap:.2f} %"
        found = [_same(row, value) for value in (row.reference, row.lkh3)]
        columns = [f"{row.proof.makespan:.6f}", f"{row.proof.bound:.6f}", proved, f"{row.seconds:.1f}"]
        lines.append(f"| {' | '.join([row.label, *columns, f'{row.by_subsets:.6f}', *found])} |")
    return "\n".join(lines)


def _same(row: Checked, value: float) -> str:
    return "reached" if row.reached(value) else f"{value:.6f}"


def main(out: Path = REPORT) -> int:
    """Print the table and write it to ``out``; 1 where something does not hold."""
    rows = check()
    versions = {k: v for name in ("exact", "reference", "lkh3") for k, v in SOLVERS[name].versions().items()}
    held = f"{sum(row.holds for row in rows)} of {len(rows)} instances"
    text = f"""# Optima of tiny instances

`python -m benchmarks.solvers.exact`: uniform instances of seed {SEED}; one thread;
{", ".join(f"{package} {version}" for package, version in versions.items())}.

"All sets" is the optimum by dynamic programming over all sets of cities, which agrees with trying everything where the
tests do so (n <= 8). Proved: the bound is within {exact.PROVED:g} of the makespan. Reached: within {EQUAL:g} of
"all sets", by the reference solver in {REFERENCE_SECONDS:g} s, by LKH in {LKH_SECONDS:g} s at most.

All of this holds for {held}.

{markdown(rows)}
"""
    print(text)
    replace_text(out, text)
    return int(not all(row.holds for row in rows))

"""Test sets: the instances of the paper's tables. Nothing is trained or tuned on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.distributions import sample
from mtsp_env.instance import Instance, Tours
from mtsp_env.machine import check_memory
from mtsp_env.tsplib import read_tsplib

SEED = 7  # of the test sets drawn here
PUBLIC_SEED = 3333  # of the public test set
PUBLIC_SIZE = 100  # instances of each n in the public test set
MOST_INSTANCES = 10_000  # in a cell
BYTES_PER_INSTANCE = 1000  # beside those of its coordinates


@dataclass(frozen=True)
class Size:
    """``count`` instances with n nodes, the depot included, and m agents."""

    n_nodes: int
    n_agents: int
    count: int

    @property
    def label(self) -> str:
        """For example "50x5" for n = 50 and m = 5."""
        return f"{self.n_nodes}x{self.n_agents}"

    @property
    def heading(self) -> str:
        """Head of the cell's column in a table, such as "50, 5"."""
        return f"{self.n_nodes}, {self.n_agents}"

    @property
    def printed(self) -> list[str | int]:
        """The cell's name in ``published.json``."""
        return [self.n_nodes, self.n_agents]


@dataclass(frozen=True)
class Cell(Size):
    """``count`` uniform instances of one size. They depend on (seed, n, m) alone."""

    def instances(self, seed: int, distribution: str = "uniform") -> list[Instance]:
        """Draw the cell's instances; the first k are the same for every ``count``."""
        check_memory("instances", self.count, BYTES_PER_INSTANCE + 16 * self.n_nodes)
        rng = np.random.default_rng([seed, self.n_nodes, self.n_agents])
        return [
            sample(distribution, rng, 1, self.n_nodes, self.n_agents).instance(0, f"{self.label}-{i}")
            for i in range(self.count)
        ]

    def file(self, seed: int) -> str:
        """Name of the file with its best known tours."""
        return f"uniform-{self.label}-seed{seed}.json"


@dataclass(frozen=True)
class PublicCell(Size):
    """The first ``count`` instances of the public test set of Equity-Transformer, DPN and UDC, for one n and m.

    They are the rows of ``np.random.seed(3333); np.random.uniform(size=(100, n, 2))``, whose node 0 is the depot, so
    that every m has the same nodes.

    Raises:
        ValueError: a ``count`` above 100.
    """

    def __post_init__(self) -> None:
        if self.count > PUBLIC_SIZE:
            raise ValueError(f"instances must be at most {PUBLIC_SIZE} in the public test set, got {self.count}")

    def instances(self, seed: int) -> list[Instance]:
        """Draw the cell's instances. Raises ValueError for another seed than 3333, which gives other instances."""
        if seed != PUBLIC_SEED:
            raise ValueError(f"the seed of the public test set is {PUBLIC_SEED}, got {seed}")
        nodes = np.random.RandomState(seed).uniform(size=(PUBLIC_SIZE, self.n_nodes, 2))
        return [Instance(nodes[i], self.n_agents, f"{self.label}-{i}") for i in range(self.count)]

    def file(self, seed: int) -> str:
        """Name of the file with its best known tours."""
        return f"public-{self.label}-seed{seed}.json"


@dataclass(frozen=True)
class TsplibCell:
    """A TSPLIB file; its first node is the depot. The instance does not depend on a seed.

    Attributes:
        file_name: name of the file without ".tsp".
        n_nodes: number of nodes that the file must have.
        n_agents: number of agents.
        folder: folder with the file; None if it is unknown, and then there is no instance.
        paper_name: the paper's name for the file, if it differs.
    """

    file_name: str
    n_nodes: int
    n_agents: int
    folder: Path | None = None
    paper_name: str | None = None
    count: int = 1

    @property
    def path(self) -> Path | None:
        """Path of the file."""
        return self.folder / f"{self.file_name}.tsp" if self.folder else None

    def instances(self, seed: int) -> list[Instance]:
        """Read the instance. Raises OSError or ValueError if the file is missing or not as expected."""
        if self.path is None:
            raise ValueError(f"{self.label} is read from a TSPLIB file: name its folder with --tsplib DIR")
        instance = read_tsplib(self.path, self.n_agents)
        if instance.n_nodes != self.n_nodes:
            raise ValueError(f"{self.path}: {self.n_nodes} nodes expected, got {instance.n_nodes}")
        return [instance]

    @property
    def label(self) -> str:
        """For example "eil51x5" for m = 5."""
        return f"{self.file_name}x{self.n_agents}"

    @property
    def heading(self) -> str:
        """Head of the cell's column in a table, such as "eil51, 5"."""
        return f"{self.file_name}, {self.n_agents}"

    @property
    def printed(self) -> list[str | int]:
        """The cell's name in ``published.json``."""
        return [self.paper_name or self.file_name, self.n_agents]

    def file(self, seed: int) -> str:
        """Name of the file with its best known tours."""
        return f"{self.label}.json"


AnyCell = Cell | PublicCell | TsplibCell

# The paper prints the costs of gtsp150 as "kroa150". In TSPLIB's kroA150, with its first node as the depot, the trip to
# the farthest city and back is 5395 long; in gtsp150 it has the length that the paper prints, 1554.64.
_TSPLIB = (("eil51", 51), ("eil76", 76), ("eil101", 101), ("gtsp150", 150), ("tsp225", 225))

TABLES: dict[str, tuple[AnyCell, ...]] = {
    "1": tuple(
        Cell(n, m, 20) for n, teams in ((50, (5, 7, 10)), (100, (5, 10, 15)), (200, (10, 15, 20))) for m in teams
    ),
    "2": tuple(Cell(n, 10, 5) for n in (500, 600, 700, 800, 900, 1000)),
    "3": tuple(
        TsplibCell(name, n, m, paper_name="kroa150" if name == "gtsp150" else None)
        for name, n in _TSPLIB
        for m in ((5, 10) if n < 150 else (10, 20))
    ),
    "figure4": tuple(
        Cell(n, 5, 5) for n in (20, 50, 100, 140, 200, 350, 500, 700, 1000)
    ),  # the paper's figure ends at 140
    "seed3333": tuple(
        PublicCell(n, m, 100 if n < 500 else 10)
        for n, teams in (
            (50, (5, 7, 10)),
            (100, (5, 7, 10)),
            (200, (10, 15, 20)),
            (500, (10,)),
            (1000, (10,)),
            (500, (30,)),
            (1000, (50,)),
        )
        for m in teams
    ),
    "smoke": (Cell(8, 2, 3),),
}


def seed_of(table: str, seed: int | None = None) -> int:
    """The seed of a table's instances: ``seed``, or by default the table's own.

    Raises:
        ValueError: a negative seed, or another one than 3333 for the public test set.
    """
    if seed is not None:
        check_count("seed", seed, minimum=0)
    if table != "seed3333":
        return SEED if seed is None else seed
    if seed not in (None, PUBLIC_SEED):
        raise ValueError(f"the seed of table {table} is {PUBLIC_SEED}, got {seed}")
    return PUBLIC_SEED


def check_instances(count: int, minimum: int = 1) -> None:
    """Raise ValueError unless a cell may have that many instances."""
    check_count("instances", count, minimum)
    if count > MOST_INSTANCES:
        raise ValueError(f"instances must be at most {MOST_INSTANCES}, got {count}")


def cells(table: str, tsplib: Path | None = None, count: int | None = None) -> tuple[AnyCell, ...]:
    """The cells of a table.

    Args:
        table: key of TABLES.
        tsplib: folder with TSPLIB files; cells whose file is not in it are left out.
        count: number of instances in each cell; by default as in TABLES.

    Raises:
        ValueError: an unknown table, a bad ``count``, or a folder without any of the files.
    """
    if table not in TABLES:
        raise ValueError(f"unknown table {table!r}; choose from {sorted(TABLES)}")
    chosen = TABLES[table]
    if count is not None:
        check_instances(count)
        if any(isinstance(cell, TsplibCell) for cell in chosen) and count != 1:
            raise ValueError(f"table {table} has 1 instance in each cell, got instances = {count}")
        chosen = tuple(replace(cell, count=count) for cell in chosen)
    if tsplib is not None:
        chosen = tuple(replace(cell, folder=tsplib) if isinstance(cell, TsplibCell) else cell for cell in chosen)
        chosen = tuple(cell for cell in chosen if not isinstance(cell, TsplibCell) or cell.path.is_file())
        if not chosen:
            raise ValueError(f"{tsplib}: none of {', '.join(f'{name}.tsp' for name, _ in _TSPLIB)}")
    return chosen


def choose(chosen: Sequence[AnyCell], labels: Sequence[str]) -> list[AnyCell]:
    """The cells with these labels; all if there are no labels. Raises ValueError for an unknown one."""
    known = [cell.label for cell in chosen]
    for label in labels:
        if label not in known:
            raise ValueError(f"unknown cell {label!r}; choose from {known}")
    return [cell for cell in chosen if not labels or cell.label in labels]


def find_cell(table: str, label: str) -> AnyCell:
    """The cell of a table with this label. Raises ValueError if there is none."""
    for cell in cells(table):
        if cell.label == label:
            return cell
    raise ValueError(f"table {table} has no cell {label!r}; choose from {[cell.label for cell in cells(table)]}")


def rounded_length(instance: Instance, tours: Tours) -> int:
    """Longest tour in the file's units, with each leg rounded to the nearest whole number (TSPLIB 95, EUC_2D).

    The paper's Table 3 rounds in this way: two of its costs are below the optimum for unrounded lengths.
    """
    lengths = (np.linalg.norm(np.diff(instance.nodes[tour], axis=0), axis=1) * instance.scale for tour in tours)
    return max(int(np.floor(legs + 0.5).sum()) for legs in lengths)


def rounded_bound(instance: Instance) -> int:
    """A lower bound on ``rounded_length``: twice the length of the shortest path from the depot to the farthest city.

    That path may be shorter than the direct leg, because rounded legs break the triangle inequality.
    """
    legs = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1) * instance.scale
    legs = np.floor(legs + 0.5)  # (n, n)
    paths = legs[0]
    while (shorter := (paths[:, None] + legs).min(0)).sum() < paths.sum():  # legs[i, i] is 0: no path becomes longer
        paths = shorter
    return 2 * int(paths.max())

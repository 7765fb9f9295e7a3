"""The test sets of the leaderboard."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks import suite
from benchmarks.suite import AnyCell


@dataclass(frozen=True)
class TestSet:
    """A set of instances that methods are compared on.

    Attributes:
        table: key of ``suite.TABLES``, whose cells and numbers of instances it has.
        title: heading on the page.
        text: what the page says about its instances.
        files: files in ``benchmarks/results`` with this project's own rows.
    """

    table: str
    title: str
    text: str
    files: tuple[str, ...]

    @property
    def seed(self) -> int:
        """Seed of the instances."""
        return suite.seed_of(self.table)

    @property
    def cells(self) -> dict[str, AnyCell]:
        """Its cells by label, such as "50x5"."""
        return {cell.label: cell for cell in suite.cells(self.table)}


WORLDS = "worlds"  # the one test set of games instead of tours: ``benchmarks.leaderboard.worlds``
TEST_SETS: dict[str, TestSet] = {
    "public": TestSet(
        table="seed3333",
        title="The public test set",
        text="`np.random.seed(3333); np.random.uniform(size=(100, n, 2))`, row 0 the depot: the test set of "
        "Equity-Transformer, DPN and UDC. It has 100 instances of each size with n up to 200, and 10 of the others. "
        "*Published* numbers are the papers' means of all 100 instances, which nobody here has judged.",
        files=("seed3333/rows.jsonl.gz",),
    ),
    "uniform": TestSet(
        table="1",
        title="Uniform instances",
        text="`default_rng([7, n, m])`, the sizes of the DAN paper's Table 1, 20 instances of each "
        "([suite.py](../benchmarks/suite.py) draws them).",
        files=("table1.jsonl.gz", "networks.jsonl.gz"),
    ),
}


def find(name: str) -> TestSet:
    """The test set of that name. Raises ValueError for an unknown one."""
    if name not in TEST_SETS:
        raise ValueError(f"unknown test set {name!r}; choose from {[*sorted(TEST_SETS), WORLDS]}")
    return TEST_SETS[name]

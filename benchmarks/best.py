"""Best known tours of the test sets: kept in the repository, verified by the judge, only ever improved.

One file for each (set, size, seed): a list of one instance's tours a line, null where none are known.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from rich.progress import track

from benchmarks.files import replace_text
from benchmarks.rows import Row
from benchmarks.suite import TABLES, AnyCell, Cell, TsplibCell, find_cell
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, lower_bound, makespan

FOLDER = Path(__file__).parent / "best"
CLOSED = 1e-9  # a makespan within this of the lower bound cannot be improved


def read(cell: AnyCell, seed: int, folder: Path = FOLDER) -> dict[int, Tours]:
    """Best known tours by the number of the instance, verified; those that the cell does not count are left out.

    Raises:
        ValueError: not such a file, or tours that do not solve their instance; the message names it.
    """
    kept, file = _kept(cell, seed, folder), folder / cell.file(seed)
    found = {i: tours for i, tours in enumerate(kept[: cell.count]) if tours is not None}
    instances = cell.instances(seed) if found else []
    for i, tours in found.items():
        try:
            check_tours(instances[i], tours)
        except ValueError as error:
            raise ValueError(f"{file}: instance {i}: {error}") from error
    return found


def _kept(cell: AnyCell, seed: int, folder: Path) -> list[Tours | None]:
    file = folder / cell.file(seed)
    if not file.exists():
        return []
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: not JSON ({error})") from error
    if not isinstance(kept, list):
        raise ValueError(f"{file}: expected a list of tours, got {type(kept).__name__}")
    return kept


def merge(cell: AnyCell, seed: int, found: Mapping[int, Tours], folder: Path = FOLDER) -> int:
    """Keep what is better than the kept tours, by the number of the instance; returns how many were.

    The file is replaced as a whole, or not at all.

    Raises:
        ValueError: tours that do not solve their instance.
    """
    cell = replace(cell, count=max([cell.count, len(_kept(cell, seed, folder)), *(i + 1 for i in found)]))
    kept, instances, better = read(cell, seed, folder), cell.instances(seed), 0
    for i, tours in found.items():
        check_tours(instances[i], tours)
        instance = instances[i]
        if i not in kept or makespan(instance, tours) < makespan(instance, kept[i]) - 1e-12:
            kept[i] = tours
            better += 1
    if better:
        lines = ",\n".join(json.dumps(kept.get(i), separators=(",", ":")) for i in range(max(kept) + 1))
        replace_text(folder / cell.file(seed), f"[\n{lines}\n]\n")
    return better


def merge_rows(rows: Iterable[Row], tsplib: Path | None = None, folder: Path = FOLDER) -> list[str]:
    """Keep the better tours of results; one line for each cell that has any."""
    found: dict[tuple[AnyCell, int], dict[int, Tours]] = defaultdict(dict)
    for row in sorted((row for row in rows if row.ok), key=lambda row: -row.makespan):  # the best comes last
        cell = find_cell(row.table, row.cell)
        cell = replace(cell, folder=tsplib) if isinstance(cell, TsplibCell) else replace(cell, count=1)
        found[cell, row.seed][row.instance] = row.tours
    return [
        f"{cell.label}: {merge(cell, seed, best, folder)} of {len(best)} improved"
        for (cell, seed), best in found.items()
    ]


def search(cell: AnyCell, seed: int, seconds: float, workers: int = 1, folder: Path = FOLDER) -> str:
    """Give every instance ``seconds`` of the reference solver afresh, and as many from its best known tours."""
    kept = read(cell, seed, folder)

    def improved(job: tuple[int, Instance]) -> tuple[int, Tours]:
        i, instance = job
        return i, _improved(instance, kept.get(i), seconds, seed + i)

    with ThreadPoolExecutor(workers) as pool:  # the solver's kernels run outside of Python's lock
        jobs = pool.map(improved, enumerate(cell.instances(seed)))
        found = dict(track(jobs, total=cell.count, description=cell.label))
    return f"{cell.label}: {merge(cell, seed, found, folder)} of {cell.count} improved"


def _improved(instance: Instance, tours: Tours | None, seconds: float, seed: int) -> Tours:
    from mtsp_env.reference import improve  # Numba: only where it is needed

    if tours is not None and makespan(instance, tours) <= lower_bound(instance) + CLOSED:
        return tours
    found = improve(instance, seconds=seconds, seed=seed)
    if tours is None:
        return found
    polished = improve(instance, tours, seconds=seconds, seed=seed)
    return min(found, polished, key=lambda one: makespan(instance, one))


def kept_cells(tsplib: Path | None = None, folder: Path = FOLDER) -> list[tuple[AnyCell, int]]:
    """Every (cell, seed) that tours are kept of; those of TSPLIB only where ``tsplib`` says where its files are."""
    found: list[tuple[AnyCell, int]] = []
    for file in sorted(folder.glob("*.json")):
        if size := re.fullmatch(r"uniform-(\d+)x(\d+)-seed(\d+)\.json", file.name):
            n, m, seed = map(int, size.groups())
            found.append((Cell(n, m, len(_kept(Cell(n, m, 1), seed, folder))), seed))
    if tsplib is not None:
        found += [(replace(c, folder=tsplib), 0) for c in TABLES["3"] if (folder / c.file(0)).exists()]
    return found


def check(cell: AnyCell, seed: int, folder: Path = FOLDER) -> str:
    """Verify the kept tours of a cell, in one line. Raises as ``read``."""
    kept, instances = read(cell, seed, folder), cell.instances(seed)
    costs = {i: makespan(instances[i], tours) for i, tours in kept.items()}
    proved = sum(cost <= lower_bound(instances[i]) + CLOSED for i, cost in costs.items())
    mean = f", mean {sum(costs.values()) / len(costs):.4f}" if costs else ""
    return f"{cell.label}: {len(kept)} of {cell.count} instances{mean}, {proved} at the lower bound"

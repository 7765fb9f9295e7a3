"""Best known tours of the test sets: kept in the repository, checked by the judge, and only ever improved.

There is one file for each (test set, size, seed): a JSON list with the tours of one instance on each line, or null if
none are known.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import msgspec
from rich.progress import track

from benchmarks import suite
from benchmarks.files import write_text
from benchmarks.harness.judge import read_judged
from benchmarks.harness.rows import Row
from benchmarks.suite import AnyCell, Cell, PublicCell, TsplibCell
from mtsp_env.instance import Instance, Tours
from mtsp_env.reading import read_file
from mtsp_env.tours import check_tours, lower_bound, makespan
from mtsp_env.writing import alone_in

FOLDER = Path(__file__).parent / "best"
TOLERANCE = 1e-9  # a makespan within this of the lower bound is optimal


def read(cell: AnyCell, seed: int, folder: Path = FOLDER) -> dict[int, Tours]:
    """Read the best known tours of a cell by the number of the instance, at most ``cell.count``.

    Raises:
        ValueError: a damaged file, or tours that do not solve their instance; the message names the file.
    """
    file = folder / cell.file(seed)
    kept = {i: tours for i, tours in enumerate(_read_file(file)[: cell.count]) if tours is not None}
    instances = cell.instances(seed) if kept else []
    for i, tours in kept.items():
        try:
            check_tours(instances[i], tours)
        except ValueError as error:
            raise ValueError(f"{file}: instance {i}: {error}") from error
    return kept


def _read_file(file: Path) -> list[Tours | None]:
    if not file.exists():
        return []
    content = read_file(file)
    try:
        kept = json.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not JSON ({error})") from error
    try:
        return msgspec.convert(kept, list[Tours | None])
    except msgspec.ValidationError as error:
        raise ValueError(f"{file}: expected a list of tours ({error})") from error


def merge(cell: AnyCell, seed: int, candidates: Mapping[int, Tours], folder: Path = FOLDER) -> int:
    """Keep those of the candidates that are better than the kept tours; returns how many were.

    Processes that do so at the same time wait for one another.

    Raises:
        ValueError: a damaged file, or tours that do not solve their instance.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with alone_in(folder):
        return _merge(cell, seed, candidates, folder)


def _merge(cell: AnyCell, seed: int, candidates: Mapping[int, Tours], folder: Path) -> int:
    file = folder / cell.file(seed)
    cell = replace(cell, count=max([cell.count, len(_read_file(file)), *(i + 1 for i in candidates)]))
    kept, instances, improved = read(cell, seed, folder), cell.instances(seed), 0
    for i, tours in candidates.items():
        check_tours(instances[i], tours)
        instance = instances[i]
        if i not in kept or makespan(instance, tours) < makespan(instance, kept[i]) - 1e-12:
            kept[i] = tours
            improved += 1
    if improved:
        lines = ",\n".join(json.dumps(kept.get(i), separators=(",", ":")) for i in range(max(kept) + 1))
        write_text(file, f"[\n{lines}\n]\n")
    return improved


def merge_rows(results: Iterable[Row], tsplib: Path | None = None, folder: Path = FOLDER) -> list[str]:
    """Keep the better tours of these results; returns one line for each cell that has any."""
    candidates: dict[tuple[AnyCell, int], dict[int, Tours]] = defaultdict(dict)
    for row in sorted((row for row in results if row.ok), key=lambda row: -row.makespan):  # the best comes last
        cell = suite.find_cell(row.table, row.cell)
        cell = replace(cell, folder=tsplib) if isinstance(cell, TsplibCell) else replace(cell, count=1)
        candidates[cell, row.seed][row.instance] = row.tours
    return [
        f"{cell.label}: {merge(cell, seed, tours, folder)} of {len(tours)} improved"
        for (cell, seed), tours in candidates.items()
    ]


def search_cell(cell: AnyCell, seed: int, seconds: float, workers: int = 1, folder: Path = FOLDER) -> str:
    """Run the reference solver on every instance for ``seconds``, and again from its best known tours; keep the best.

    Returns one line that says how many instances were improved.
    """
    kept = read(cell, seed, folder)

    def improve_one(job: tuple[int, Instance]) -> tuple[int, Tours]:
        i, instance = job
        return i, _improve(instance, kept.get(i), seconds, seed + i)

    with ThreadPoolExecutor(workers) as pool:  # the solver's kernels release Python's lock
        jobs = pool.map(improve_one, enumerate(cell.instances(seed)))
        tours = dict(track(jobs, total=cell.count, description=cell.label))
    return f"{cell.label}: {merge(cell, seed, tours, folder)} of {cell.count} improved"


def _improve(instance: Instance, kept: Tours | None, seconds: float, seed: int) -> Tours:
    from mtsp_env.reference import improve  # imports Numba

    if kept is not None and makespan(instance, kept) <= lower_bound(instance) + TOLERANCE:
        return kept
    fresh = improve(instance, seconds=seconds, seed=seed)
    if kept is None:
        return fresh
    improved = improve(instance, kept, seconds=seconds, seed=seed)
    return min(fresh, improved, key=lambda tours: makespan(instance, tours))


def kept_cells(tsplib: Path | None = None, folder: Path = FOLDER) -> list[tuple[AnyCell, int]]:
    """Every (cell, seed) with kept tours; TSPLIB cells only if ``tsplib`` names the folder of their files."""
    cells: list[tuple[AnyCell, int]] = []
    for file in sorted(folder.glob("*.json")):
        if parts := re.fullmatch(r"(uniform|public)-(\d+)x(\d+)-seed(\d+)\.json", file.name):
            n, m, seed = map(int, parts.groups()[1:])
            kind = Cell if parts[1] == "uniform" else PublicCell
            cells.append((kind(n, m, len(_read_file(file))), seed))
    if tsplib is not None:
        cells += [(replace(c, folder=tsplib), 0) for c in suite.TABLES["3"] if (folder / c.file(0)).exists()]
    return cells


def verify(cell: AnyCell, seed: int, folder: Path = FOLDER) -> str:
    """Check the kept tours of a cell; returns one line about them. Raises as ``read``."""
    kept, instances = read(cell, seed, folder), cell.instances(seed)
    costs = {i: makespan(instances[i], tours) for i, tours in kept.items()}
    proved = sum(cost <= lower_bound(instances[i]) + TOLERANCE for i, cost in costs.items())
    mean = f", mean {sum(costs.values()) / len(costs):.4f}" if costs else ""
    return f"{cell.label}: {len(kept)} of {cell.count} instances{mean}, {proved} at the lower bound"


def main(
    check: bool = False,
    merge: tuple[Path, ...] = (),
    search: float | None = None,
    table: str | None = None,
    instances: int | None = None,
    seed: int | None = None,
    workers: int = 1,
    tsplib: Path | None = None,
    cells: tuple[str, ...] = (),
) -> None:
    """Maintain the best known tours: take better ones from results, search for better ones, check them, in this order.

    Args:
        check: check the kept tours.
        merge: files of results to take better tours from.
        search: seconds of the reference solver for each instance.
        table: 1, 2, 3, figure4, seed3333 or smoke; by default every cell with kept tours.
        instances: number of instances in each cell of the table; by default the table's.
        seed: seed of the table's instances; by default 7, and 3333 for the table seed3333.
        workers: number of threads of the search.
        tsplib: folder with the TSPLIB files of table 3.
        cells: labels of the table's cells to search and check, such as 50x5; by default all of them.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: nothing to do, an unknown table or cell, cells without a table, or damaged files.
    """
    if search is None and not check and not merge:
        raise ValueError("choose at least one of --merge FILES, --search SECONDS and --check")
    if cells and table is None:
        raise ValueError(f"name the table of the cells {list(cells)} with --table")
    if merge:
        print("\n".join(merge_rows(read_judged(merge, tsplib), tsplib)))
    if search is None and not check:
        return
    if table is None:
        chosen = kept_cells(tsplib)
    else:
        table_seed = suite.seed_of(table, seed)
        chosen = [(cell, table_seed) for cell in suite.choose(suite.cells(table, tsplib, instances), cells)]
    for cell, cell_seed in chosen if search is not None else ():
        print(search_cell(cell, cell_seed, search, workers))
    for cell, cell_seed in chosen if check else ():
        print(verify(cell, cell_seed))

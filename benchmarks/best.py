"""Best known tours of the test sets: kept in the repository, verified by the judge, only ever improved."""

from __future__ import annotations

import json
import os
from pathlib import Path

from rich.progress import track

from benchmarks.suite import Cell, cells
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, lower_bound, makespan

FOLDER = Path(__file__).parent / "best"
CLOSED = 1e-9  # a makespan within this of the lower bound cannot be improved


def path(cell: Cell, seed: int, folder: Path = FOLDER) -> Path:
    """One file per (size, seed)."""
    return folder / f"uniform-{cell.label}-seed{seed}.json"


def read(cell: Cell, seed: int, folder: Path = FOLDER) -> list[Tours]:
    """Best known tours of the cell's instances, verified.

    Raises:
        OSError: none are kept.
        ValueError: too few, or tours that do not solve their instance.
    """
    kept = json.loads(path(cell, seed, folder).read_text())
    if len(kept) < cell.count:
        raise ValueError(f"{path(cell, seed, folder)}: tours of {len(kept)} instances, {cell.count} needed")
    for instance, tours in zip(cell.instances(seed), kept, strict=False):
        check_tours(instance, tours)
    return kept[: cell.count]


def costs(cell: Cell, seed: int, folder: Path = FOLDER) -> list[float]:
    """Makespans of the best known tours."""
    kept = read(cell, seed, folder)
    return [makespan(i.nodes, tours) for i, tours in zip(cell.instances(seed), kept, strict=True)]


def merge(cell: Cell, seed: int, found: list[Tours], folder: Path = FOLDER) -> int:
    """Keep what is better than the kept tours; returns how many were. Replaced atomically."""
    file = path(cell, seed, folder)
    kept = json.loads(file.read_text()) if file.exists() else []
    better = 0
    for i, (instance, tours) in enumerate(zip(cell.instances(seed), found, strict=True)):
        check_tours(instance, tours)
        if i >= len(kept):
            kept.append(tours)
            better += 1
        elif makespan(instance.nodes, tours) < makespan(instance.nodes, kept[i]) - 1e-12:
            kept[i] = tours
            better += 1
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(f".{os.getpid()}.tmp")
    temporary.write_text("[\n" + ",\n".join(json.dumps(tours, separators=(",", ":")) for tours in kept) + "\n]\n")
    os.replace(temporary, file)
    return better


def search(name: str, seed: int, seconds: float, folder: Path = FOLDER) -> None:
    """Give every instance ``seconds`` of the reference solver afresh, and as many from its best known tours."""
    for cell in cells(name):
        instances, file = cell.instances(seed), path(cell, seed, folder)
        kept = json.loads(file.read_text())[: cell.count] if file.exists() else []
        kept += [None] * (cell.count - len(kept))
        jobs = track(list(zip(instances, kept, strict=True)), description=f"{name} {cell.label}")
        found = [_improved(instance, tours, seconds, seed + i) for i, (instance, tours) in enumerate(jobs)]
        print(f"{cell.label}: {merge(cell, seed, found, folder)} of {cell.count} improved")


def _improved(instance: Instance, tours: Tours | None, seconds: float, seed: int) -> Tours:
    from mtsp_env.reference import improve  # numba: only where it is needed

    if tours is not None and makespan(instance.nodes, tours) <= lower_bound(instance) + CLOSED:
        return tours
    found = improve(instance, seconds=seconds, seed=seed)
    if tours is None:
        return found
    polished = improve(instance, tours, seconds=seconds, seed=seed)
    return min(found, polished, key=lambda one: makespan(instance.nodes, one))


def check(name: str, seed: int, folder: Path = FOLDER) -> str:
    """Verify the kept tours of a set; one line per cell."""
    lines = []
    for cell in cells(name):
        found = costs(cell, seed, folder)
        bounds = [lower_bound(instance) for instance in cell.instances(seed)]
        proved = sum(cost <= bound + CLOSED for cost, bound in zip(found, bounds, strict=True))
        lines.append(
            f"{cell.label}: {len(found)} instances, mean {sum(found) / len(found):.4f}, {proved} at the lower bound"
        )
    return "\n".join(lines)

"""Solvers for the tables: ``solve(instance, seconds, seed) -> tours``, one file each; SOLVERS names them.

Naming a solver imports nothing: its module, and what that module needs, is loaded when ``find`` is asked for it.
"""

from __future__ import annotations

import hashlib
import importlib
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from mtsp_env import version
from mtsp_env.instance import Instance, Tours


class Unavailable(RuntimeError):
    """The solver cannot run here: a package, a program or a licence is missing. The message says which."""


class NoTours(RuntimeError):
    """The solver found no tours within its time."""


class Answer(NamedTuple):
    """What a solver may return that knows more than tours.

    Attributes:
        tours: one per agent, [0, ..., 0].
        bound: no makespan is below this, in the unit square's lengths; None: not known.
    """

    tours: Tours
    bound: float | None = None


Solve = Callable[[Instance, float, int], "Tours | Answer"]


@dataclass(frozen=True)
class Solver:
    """Where a solver is found, and what the tables must know of it.

    Attributes:
        target: "package.module:function".
        options: keyword arguments bound to the function.
        anytime: it goes on for as long as it may, so that it is run once for each budget of seconds. Others are run
            once, and only limited.
        polishes: its budget begins when it has tours, which take as long as they take.
        packages: the distributions whose versions belong to a result.
        programs: names of programs that are used instead where they are on the PATH.
        weights: the shipped model that it plays, whose hash belongs to a result; None: none.
    """

    target: str
    options: dict[str, Any] = field(default_factory=dict)
    anytime: bool = True
    polishes: bool = False
    packages: tuple[str, ...] = ("numpy",)
    programs: tuple[str, ...] = ()
    weights: str | None = None

    def load(self) -> Solve:
        """The function ``solve(instance, seconds, seed)``.

        Raises:
            ValueError: there is no such module or function.
            Unavailable: the module needs a package that is missing.
        """
        module, _, name = self.target.partition(":")
        try:
            function = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as error:
            if error.name and (module == error.name or module.startswith(f"{error.name}.")):
                raise ValueError(f"no solver at {self.target!r}: no module named {error.name!r}") from error
            raise Unavailable(f"package {error.name} is missing") from error
        except AttributeError as error:
            raise ValueError(f"no solver at {self.target!r}: {error}") from error
        return partial(function, **self.options) if self.options else function

    def versions(self) -> dict[str, str]:
        """What a result depends on: versions of packages; of programs and weights, the beginning of their SHA-256."""
        found = {"mtsp-env": version.__version__}
        for package in self.packages:
            with suppress(metadata.PackageNotFoundError):
                found[package] = metadata.version(package)
        for program in self.programs:
            if path := shutil.which(program):
                found[program] = _digest(Path(path))
        if self.weights is not None:
            folder = Path(find_spec("dan_policy").origin).parent / "weights"
            found["weights"] = _digest(folder / f"{self.weights}.safetensors")
        return found


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def _ours(
    target: str,
    *packages: str,
    anytime: bool = True,
    polishes: bool = False,
    programs: tuple[str, ...] = (),
    weights: str | None = None,
    **options: Any,
) -> Solver:
    return Solver(f"{__name__}.{target}", options, anytime, polishes, ("numpy", *packages), programs, weights)


def _policy(target: str, *packages: str, anytime: bool = False, **more: Any) -> Solver:
    return _ours(f"policy:{target}", "torch", "tensordict", "torchrl", *packages, anytime=anytime, **more)


SOLVERS: dict[str, Solver] = {
    "random": _policy("uniformly_random"),
    "nearest": _policy("nearest"),
    "dan-greedy": _policy("dan", weights="default"),
    "dan-greedy-x8": _policy("dan", weights="default", augment=True),
    "dan-s64": _policy("dan", weights="default", samples=64),
    "dan-s64-x8": _policy("dan", weights="default", samples=64, augment=True),
    "dan-s256": _policy("dan", weights="default", samples=256),
    "dan-paper-greedy": _policy("dan", weights="paper", policy="paper"),
    "dan-paper-s64": _policy("dan", weights="paper", policy="paper", samples=64),
    "dan-improve": _policy("improved_dan", "numba", anytime=True, polishes=True, weights="default"),
    "reference": _ours("reference:solve", "numba"),
    "ortools": _ours("ortools:solve", "ortools", search="greedy_descent"),
    "ortools-gls": _ours("ortools:solve", "ortools", search="guided"),
    "ortools-first": _ours("ortools:solve", "ortools", search="first", anytime=False),
    "lkh3": _ours("lkh3:solve", "elkai", programs=("LKH",)),
    "exact": _ours("exact:solve", "highspy", backend="highs"),
    "exact-gurobi": _ours("exact:solve", "gurobipy", backend="gurobi"),
    "exact-cplex": _ours("exact:solve", "cplex", backend="cplex"),
    "ea": _ours("ea:solve"),
    "som": _ours("som:solve"),
}

GROUPS: dict[str, tuple[str, ...]] = {
    "dan": ("dan-greedy", "dan-greedy-x8", "dan-s64", "dan-s64-x8", "dan-s256", "dan-improve"),
    "all": tuple(SOLVERS),
}


def look_up(name: str) -> Solver:
    """The solver of that name; "package.module:function" names any importable function.

    Raises:
        ValueError: there is no such name.
    """
    if name in SOLVERS:
        return SOLVERS[name]
    if ":" in name:
        return Solver(name)
    raise ValueError(
        f"unknown solver {name!r}; choose from {sorted([*SOLVERS, *GROUPS])}, or give package.module:function"
    )


def find(name: str) -> Solve:
    """The function of the solver of that name. Raises as ``look_up`` and ``Solver.load``."""
    return look_up(name).load()


def expand(names: Iterable[str]) -> list[str]:
    """Names of solvers, once each and in order, from names of solvers and groups, one by one or joined by commas.

    Raises:
        ValueError: none, or an unknown one.
    """
    single = [part.strip() for name in names for part in name.split(",") if part.strip()]
    found = list(dict.fromkeys(solver for name in single for solver in GROUPS.get(name, (name,))))
    if not found:
        raise ValueError(f"name at least one solver; choose from {sorted([*SOLVERS, *GROUPS])}")
    for name in found:
        look_up(name)
    return found

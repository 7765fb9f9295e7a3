"""Solvers: functions ``solve(instance, seconds, seed) -> tours``, one file each; SOLVERS lists them by name.

A solver's module and the packages that it needs are imported by ``find``, not before.
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
    """The solver cannot run because a package, a program, a licence or weights are missing. The message says which."""


class NoTours(RuntimeError):
    """The solver found no tours in its time."""


class Answer(NamedTuple):
    """What a solver with bounds returns instead of tours.

    Attributes:
        tours: one tour per agent, [0, ..., 0].
        bound: lower bound on the makespan, in lengths of the unit square; None if it is unknown.
    """

    tours: Tours
    bound: float | None = None


WEIGHTS = Path(__file__).parents[1] / "policies" / "weights"
"""Folder with the weights of other papers' networks."""

Solve = Callable[[Instance, float, int], "Tours | Answer"]


@dataclass(frozen=True)
class Solver:
    """How to load a solver, and how it is run.

    Attributes:
        target: "package.module:function".
        options: keyword arguments bound to the function.
        anytime: whether it uses all of its budget; it is then run once for each budget. Other solvers are run once,
            under a time limit.
        polishes: whether its budget begins only when it has first tours.
        packages: distributions whose versions are recorded with a result.
        programs: programs that are used instead of a package if they are on the PATH.
        weights: names of the models that it uses, whose hash is recorded with a result: those shipped with
            ``dan_policy``, or in ``benchmarks/policies/weights``.
    """

    target: str
    options: dict[str, Any] = field(default_factory=dict)
    anytime: bool = True
    polishes: bool = False
    packages: tuple[str, ...] = ("numpy",)
    programs: tuple[str, ...] = ()
    weights: tuple[str, ...] = ()

    def load(self) -> Solve:
        """Import the function ``solve(instance, seconds, seed)``.

        Raises:
            ValueError: the module or the function does not exist.
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
        """What a result depends on: versions of packages, and the beginning of the SHA-256 of programs and weights."""
        versions = {"mtsp-env": version.__version__}
        for package in self.packages:
            with suppress(metadata.PackageNotFoundError):
                versions[package] = metadata.version(package)
        for program in self.programs:
            if path := shutil.which(program):
                versions[program] = _digest(Path(path))
        if self.weights:
            versions["weights"] = _digest(*map(_weights_file, self.weights))
        return versions


def _weights_file(name: str) -> Path:
    """The file of a model, found without importing torch."""
    shipped = Path(find_spec("dan_policy").origin).parent / "weights" / f"{name}.safetensors"
    return shipped if shipped.exists() else WEIGHTS / shipped.name


def _digest(*files: Path) -> str:
    """The beginning of the SHA-256 of these files, one after the other."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def _ours(
    target: str,
    *packages: str,
    anytime: bool = True,
    polishes: bool = False,
    programs: tuple[str, ...] = (),
    weights: tuple[str, ...] | str = (),
    **options: Any,
) -> Solver:
    weights = (weights,) if isinstance(weights, str) else weights
    return Solver(f"{__name__}.{target}", options, anytime, polishes, ("numpy", *packages), programs, weights)


def _policy(target: str, *packages: str, anytime: bool = False, **more: Any) -> Solver:
    return _ours(f"policy:{target}", "torch", "tensordict", "torchrl", *packages, anytime=anytime, **more)


SOLVERS: dict[str, Solver] = {
    "random": _policy("uniformly_random"),
    "nearest": _policy("nearest"),
    "dan-greedy": _policy("shipped", weights="dan", policy="dan"),
    "dan-greedy-x8": _policy("shipped", weights="dan", policy="dan", augment=True),
    "dan-s64": _policy("shipped", weights="dan", policy="dan", samples=64),
    "dan-s64-x8": _policy("shipped", weights="dan", policy="dan", samples=64, augment=True),
    "dan-s256": _policy("shipped", weights="dan", policy="dan", samples=256),
    "dan-paper-greedy": _policy("shipped", weights="paper", policy="paper"),
    "dan-paper-s64": _policy("shipped", weights="paper", policy="paper", samples=64),
    "joint-greedy": _policy("shipped", weights="default"),
    "joint-greedy-x8": _policy("shipped", weights="default", augment=True),
    "joint-s64": _policy("shipped", weights="default", samples=64),
    "joint-s64-x8": _policy("shipped", weights="default", samples=64, augment=True),
    "joint-r16": _policy("shipped", weights="default", augment=True, reconstruct=16),
    "dan-improve": _policy("improved", "numba", anytime=True, polishes=True, weights="dan", policy="dan"),
    "schedulenet-greedy": _policy("schedulenet", weights="schedulenet"),
    "schedulenet-greedy-x8": _policy("schedulenet", weights="schedulenet", augment=True),
    "schedulenet-s64": _policy("schedulenet", weights="schedulenet", samples=64),
    "hu-greedy": _ours("hu:solve", "torch", "ortools", anytime=False, weights=("hu-5", "hu-10")),
    "hu-s64": _ours("hu:solve", "torch", "ortools", anytime=False, weights=("hu-5", "hu-10"), samples=64),
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
    "schedulenet": ("schedulenet-greedy", "schedulenet-greedy-x8", "schedulenet-s64"),
    "hu": ("hu-greedy", "hu-s64"),
    "joint": ("joint-greedy", "joint-greedy-x8", "joint-s64", "joint-s64-x8", "joint-r16"),
    "all": tuple(SOLVERS),
}


def look_up(name: str) -> Solver:
    """The solver with this name; "package.module:function" names any importable function.

    Raises:
        ValueError: the name is unknown.
    """
    if name in SOLVERS:
        return SOLVERS[name]
    if ":" in name:
        return Solver(name)
    raise ValueError(
        f"unknown solver {name!r}; choose from {sorted([*SOLVERS, *GROUPS])}, or give package.module:function"
    )


def find(name: str) -> Solve:
    """Import the function of the solver with this name. Raises as ``look_up`` and ``Solver.load``."""
    return look_up(name).load()


def expand(names: Iterable[str]) -> list[str]:
    """Expand names of solvers and groups, separate or joined by commas, to names of solvers without duplicates.

    Raises:
        ValueError: there are no names, or one is unknown.
    """
    names = [part.strip() for name in names for part in name.split(",") if part.strip()]
    expanded = list(dict.fromkeys(solver for name in names for solver in GROUPS.get(name, (name,))))
    if not expanded:
        raise ValueError(f"name at least one solver; choose from {sorted([*SOLVERS, *GROUPS])}")
    for name in expanded:
        look_up(name)
    return expanded

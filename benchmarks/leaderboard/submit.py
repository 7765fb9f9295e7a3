"""``python -m benchmarks submit``: runs a policy or a solver on a test set, and writes its tours as a submission."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from rich.progress import track

from benchmarks import solvers, suite
from benchmarks.harness.machine import describe_machine
from benchmarks.leaderboard import test_sets, worlds
from benchmarks.leaderboard.submission import CellResult, Knows, Submission, judge, write
from benchmarks.leaderboard.test_sets import WORLDS
from benchmarks.solvers import Answer
from mtsp_env.checks import check_seconds
from mtsp_env.instance import Instance, Tours

Plan = Callable[[Instance, int], Tours]
"""From an instance and a seed to tours."""


def submit(
    *,
    out: Path,
    method: str,
    by: str,
    test_set: str = "uniform",
    policy: str | None = None,
    network: str | None = None,
    samples: int | None = None,
    augment: bool = False,
    solver: str | None = None,
    seconds: float | None = None,
    cells: tuple[str, ...] = (),
    link: str = "",
) -> str:
    """Run a policy or a solver on a test set, one instance after the other, and write its tours as a submission.

    Args:
        out: the JSON file to write, gzipped if its name ends in ".gz".
        method: the method's name on the leaderboard.
        by: who submits it.
        test_set: public, uniform, or worlds, which takes a policy alone, and plays its greedy games.
        policy: a shipped network's name or a weights file.
        network: package.module:factory of the network, if it is not a registered one.
        samples: draw that many games with the policy and take the best; by default one greedy game.
        augment: with the policy, play in the square's eight symmetries and take the best.
        solver: a solver's name, or package.module:function that takes (instance, seconds, seed).
        seconds: the solver's budget for each instance.
        cells: labels of the sizes, such as 50x5, or of worlds, such as "everything 50x5"; by default all.
        link: address of a paper or a repository.

    Returns:
        The name of the written file.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: not exactly one of policy and solver, an unknown name, or tours that do not solve their instance.
    """
    if (policy is None) == (solver is None):
        raise ValueError("choose one of --policy and --solver")
    if test_set == WORLDS and (policy is None or samples is not None or augment):
        raise ValueError("the test set worlds takes greedy games: give --policy, without --samples and --augment")
    if solver is not None and seconds is None:
        raise ValueError("--solver needs --seconds, its budget for each instance")
    if seconds is not None:
        check_seconds("seconds", seconds)
    if test_set == WORLDS:
        return _submit_games(out, method, by, policy, network, cells, link)
    chosen_set = test_sets.find(test_set)
    chosen = suite.choose(list(chosen_set.cells.values()), cells)
    plan = _policy(policy, network, samples, augment) if policy is not None else _solver(solver, seconds)
    knows: Knows = "observation" if policy is not None and samples is None and not augment else "map"
    results = {cell.label: _run(plan, cell.instances(chosen_set.seed), cell.label) for cell in chosen}
    machine = str(describe_machine()["processor"])
    submission = Submission(method, by, test_set, knows, f"{machine}, one thread", results, link)
    judge(submission)
    write(out, submission)
    return str(out)


def _run(plan: Plan, instances: list[Instance], label: str) -> CellResult:
    begin = time.perf_counter()
    tours = [plan(instance, number) for number, instance in enumerate(track(instances, description=label))]
    return CellResult(seconds=(time.perf_counter() - begin) / len(instances), tours=tours)


def _policy(policy: str, network: str | None, samples: int | None, augment: bool) -> Plan:
    import torch

    from dan_policy import SolveOptions, load, solve

    torch.set_num_threads(1)
    loaded = load(policy, network=network)
    decode = {} if samples is None else {"decode": "sample", "samples": samples}

    def plan(instance: Instance, seed: int) -> Tours:
        return solve(instance, loaded, SolveOptions(seed=seed, augment=augment, device="cpu", **decode)).tours

    return plan


def _solver(name: str, seconds: float) -> Plan:
    function = solvers.find(name)

    def plan(instance: Instance, seed: int) -> Tours:
        answer = function(instance, seconds, seed)
        return answer.tours if isinstance(answer, Answer) else answer

    return plan


def _submit_games(
    out: Path, method: str, by: str, policy: str, network: str | None, labels: tuple[str, ...], link: str
) -> str:
    """Play the test set worlds with a policy, and write the decisions as a submission."""
    from dan_policy import load
    from dan_policy.games import chooser

    known = worlds.cells()
    for label in labels:
        if label not in known:
            raise ValueError(f"unknown cell {label!r}; choose from {list(known)}")
    games = worlds.play_cells(chooser(load(policy, network=network)), labels or known)
    machine = str(describe_machine()["processor"])
    submission = Submission(method, by, WORLDS, "observation", machine, games, link)
    worlds.judge_submission(submission)
    write(out, submission)
    return str(out)

"""Games in worlds that change: learned policies beside rules of thumb and central planners, on the same instances.

Each agent of a network or a rule of thumb decides by itself, with what it observes. The planners are central: one
computer knows everything that is known to anybody, and all agents obey it. No method sees the future.

Every game is replayed from its decisions, and its makespan is the judge's (``mtsp_env.check_log``). Times are those of
the process's own CPU, with one thread, so that other work on the machine disturbs them little.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.progress import track

from benchmarks.harness.journal import Journal
from benchmarks.harness.machine import describe_machine
from benchmarks.harness.world_rows import Row, parse_lines
from benchmarks.policies.in_worlds import METHODS, Decide, find_method, is_available
from benchmarks.policies.plan_once import PlanOnce
from benchmarks.reports.worlds import write_report
from dan_policy import load, registry
from dan_policy.games import Choose, chooser
from mtsp_env import SCENARIOS, check_log, rules
from mtsp_env.checks import check_count
from mtsp_env.distributions import sample
from mtsp_env.instance import Instance, Problem, batch
from mtsp_env.log import write_log
from mtsp_env.reference import plan_rest
from mtsp_env.replan import Replanner

RESULTS = Path(__file__).parents[1] / "results" / "worlds"
SEED = 15  # of these test sets; nothing is trained or tuned on them
SPEED = 0.01  # distance per tick
ALONE = 2  # a network's first games are played one by one as well, to time its decisions


@dataclass(frozen=True)
class Cell:
    """The instances of one scenario and size."""

    scenario: str
    n_nodes: int
    n_agents: int

    @property
    def size(self) -> str:
        """For example "50x5" for n = 50 and m = 5."""
        return f"{self.n_nodes}x{self.n_agents}"

    @property
    def rules(self) -> rules.Rules:
        """The rules of its games; agents with nothing to do wait until something happens."""
        return rules.make_rules(self.n_nodes, self.n_agents, SPEED, "wait", "sparse", None)

    def instance(self, number: int) -> Instance:
        """One instance. Its nodes depend on the size and ``number`` alone: they are the same in all scenarios."""
        rng = np.random.default_rng([SEED, self.n_nodes, self.n_agents, number])
        drawn = sample("uniform", rng, 1, self.n_nodes, self.n_agents, self.scenario)
        return drawn.instance(0, f"{self.scenario}-{self.size}-{number}")


# Games


def play(instance: Instance, game_rules: rules.Rules, decide: Decide) -> tuple[list[int], float]:
    """The decisions of one game, and the CPU seconds that ``decide`` took for them."""
    state, decisions, seconds = rules.start(batch([instance]), game_rules), [], 0.0
    while not _over(state, game_rules).all():
        start = time.process_time()
        node = decide(state, game_rules)
        seconds += time.process_time() - start
        decisions.append(node)
        state = rules.depart(state, game_rules, np.array([node]))
    return decisions, seconds


def play_together(problem: Problem, game_rules: rules.Rules, choose: Choose) -> list[list[int]]:
    """The decisions of the games of a problem, played side by side. ``choose`` is asked only if there is a choice."""
    state = rules.start(problem, game_rules)
    decisions: list[list[int]] = [[] for _ in range(len(problem.nodes))]
    while not (over := _over(state, game_rules)).all():
        seen = rules.observe(state, game_rules)
        actions, asked = seen.action_mask.argmax(1), ~over & (seen.action_mask.sum(1) > 1)
        if asked.any():
            some = rules.state_from_arrays({name: a[asked] for name, a in state.arrays().items()}, problem.n_agents)
            actions[asked] = choose(some, rules.observe(some, game_rules))
        for row in np.flatnonzero(~over):
            decisions[row].append(int(actions[row]))
        state = rules.depart(state, game_rules, actions)
    return decisions


def judge(instance: Instance, game_rules: rules.Rules, decisions: list[int]) -> tuple[float, bool]:
    """The makespan of a game, and whether it was cut off.

    Raises:
        ValueError: an illegal decision, or too few or too many of them.
    """
    problem = batch([instance])
    state = rules.start(problem, game_rules)
    for count, node in enumerate(decisions):
        if _over(state, game_rules).all():
            raise ValueError(f"the game is over after {count} decisions, got {len(decisions)}")
        agent, action = rules.agent_to_decide(state), np.array([node])
        if not rules.are_legal(action, rules.legal_actions(state, game_rules, agent))[0]:
            raise ValueError(f"decision {count}: agent {agent[0]} may not go to node {node}")
        state = rules.depart(state, game_rules, action)
    if not _over(state, game_rules).all():
        raise ValueError(f"the game is not over after {len(decisions)} decisions")
    if rules.truncated(state, game_rules)[0]:
        return float(rules.final_cost(state, game_rules)[0]), True
    return check_log(instance, write_log(problem, game_rules, decisions, close=True), game_rules.speed), False


def _over(state: rules.State, game_rules: rules.Rules) -> np.ndarray:
    """(B,) bool: the games that have ended or were cut off."""
    return rules.terminated(state) | rules.truncated(state, game_rules)


def iterations_within(milliseconds: float, cell: Cell) -> int:
    """How many iterations of the search one core does in so many milliseconds of CPU time, half of the cities left.

    A limit in iterations makes the decisions the same on a busy machine as on an idle one.
    """
    instance = cell.instance(0)
    known = {name: array for name, array in instance.arrays().items() if name in ("nodes", "speeds", "service")}
    instance = Instance(n_agents=cell.n_agents, **known)
    cities, m = list(range(1, 1 + cell.n_nodes // 2)), cell.n_agents

    def seconds(iterations: int) -> float:
        times = []
        for _ in range(5):
            start = time.process_time()
            plan_rest(instance, [0] * m, np.zeros(m), cities, iterations=iterations)
            times.append(time.process_time() - start)
        return min(times)

    plan_rest(instance, [0] * m, np.zeros(m), cities, iterations=1)  # compiles the kernels
    fixed, many = seconds(0), 3000
    return max(round((milliseconds / 1000 - fixed) / ((seconds(many) - fixed) / many)), 1)


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch uses one thread within."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _play_rule(method: str, cell: Cell, number: int) -> Row:
    rule = find_method(method).rule
    assert rule is not None
    decide = rule(np.random.default_rng([SEED, number, 1]))
    return _row(method, cell, number, *play(cell.instance(number), cell.rules, decide))


def _play_planner(method: str, cell: Cell, number: int, iterations: int) -> Row:
    if method == "plan-once":
        decisions, seconds = play(cell.instance(number), cell.rules, PlanOnce(iterations))
        return _row(method, cell, number, decisions, seconds, 1, iterations)
    replanner, plan = Replanner(iterations=iterations), None

    def decide(game: rules.State, game_rules: rules.Rules) -> int:
        nonlocal plan
        node, plan = replanner.decide(game, game_rules, plan)
        return node

    decisions, seconds = play(cell.instance(number), cell.rules, decide)
    return _row(method, cell, number, decisions, seconds, replanner.plans, iterations)


def _play_network(method: str, cell: Cell, numbers: list[int], choose: Choose) -> Iterator[Row]:
    problem = batch([cell.instance(number) for number in numbers])
    for number, decisions in zip(numbers, play_together(problem, cell.rules, choose), strict=True):
        seconds = None
        if number < ALONE:
            decisions, seconds = play(
                cell.instance(number),
                cell.rules,
                lambda game, game_rules: int(choose(game, rules.observe(game, game_rules))[0]),
            )
        yield _row(method, cell, number, decisions, seconds)


def _row(
    method: str,
    cell: Cell,
    number: int,
    decisions: list[int],
    seconds: float | None,
    searches: int | None = None,
    iterations: int | None = None,
) -> Row:
    makespan, truncated = judge(cell.instance(number), cell.rules, decisions)
    counts = (len(decisions), seconds, searches, iterations)
    return Row(cell.scenario, cell.size, number, method, makespan, truncated, *counts, describe_machine())


# The command


def main(
    instances: int = 100,
    methods: tuple[str, ...] = (),
    scenarios: tuple[str, ...] = tuple(SCENARIOS),
    sizes: tuple[str, ...] = ("50x5", "100x10"),
    out: Path = RESULTS,
) -> None:
    """Play the same instances of every scenario with every method, and write a table and a plot for each size.

    A game that the file of rows already has is not played again. The table shows all methods of that file.

    Args:
        instances: number of instances of each scenario and size.
        methods: random, nearest, default, dan, world, plan-once, replanner-5, replanner-50, or files of weights; by
            default all of those whose weights are shipped.
        scenarios: names in ``mtsp_env.SCENARIOS``.
        sizes: n and m, such as 50x5.
        out: folder for the rows, the report and the plots.

    Raises:
        OSError: no such weights, or a file that cannot be written.
        ValueError: a value outside its range, or a damaged row.
    """
    check_count("instances", instances, minimum=1)
    names = methods or tuple(name for name in METHODS if is_available(name))
    cells = [_cell(scenario, size) for size in sizes for scenario in scenarios]
    for name in names:
        if find_method(name).network is not None:
            registry.find(find_method(name).network)  # says at once if it is missing
    with Journal(out / "rows.jsonl", parse_lines) as journal, one_thread():
        for name in names:
            for cell in cells:
                _complete(journal, name, cell, instances)
    write_report(out)


def _complete(journal: Journal, name: str, cell: Cell, instances: int) -> None:
    """Play the games of one method and cell that the journal does not have."""
    mine = {row.instance: row for row in journal.rows if row.key == (cell.scenario, cell.size, row.instance, name)}
    left = [number for number in range(instances) if number not in mine]
    if not left:
        return
    method, progress = find_method(name), f"{name}, {cell.scenario} {cell.size}"
    if method.network is not None:
        choose = chooser(load(method.network))
        for row in track(_play_network(name, cell, left, choose), progress, len(left), transient=True):
            journal.append(row)
    elif method.milliseconds is not None:
        known = [row.iterations for row in mine.values()]  # all games of a cell are searched equally long
        iterations = known[0] if known else iterations_within(method.milliseconds, cell)
        for number in track(left, progress, transient=True):
            journal.append(_play_planner(name, cell, number, iterations))
    else:
        for number in track(left, progress, transient=True):
            journal.append(_play_rule(name, cell, number))


def _cell(scenario: str, size: str) -> Cell:
    if scenario not in SCENARIOS:
        raise ValueError(f"unknown scenario {scenario!r}; choose from {list(SCENARIOS)}")
    n, _, m = size.partition("x")
    if not (n.isdecimal() and m.isdecimal() and int(n) >= 2 and int(m) >= 1):
        raise ValueError(f"sizes must be such as 50x5, got {size!r}")
    return Cell(scenario, int(n), int(m))

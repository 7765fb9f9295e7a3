"""Games in worlds that change: learned policies beside rules of thumb and central planners, on the same instances.

Each agent of a network or a rule of thumb decides by itself, with what it observes. The planners are central: one
computer knows everything that is known to anybody, and all agents obey it. No method sees the future.

Every game is replayed from its decisions, and its makespan is the judge's (``mtsp_env.check_log``). Times are those of
the process's own CPU, with one thread, so that other work on the machine disturbs them little.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from msgspec import Meta
from rich.progress import track

from benchmarks.harness.journal import Journal
from benchmarks.harness.machine import describe_machine
from benchmarks.policies.plan_once import PlanOnce
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

Decide = Callable[[rules.State, rules.Rules], int]
"""A game (B = 1, NumPy arrays) -> the deciding agent's next node. Each game gets one of its own."""


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
        """Those of its games; agents with nothing to do wait until something happens."""
        return rules.make_rules(self.n_nodes, self.n_agents, SPEED, "wait", "sparse", None)

    def instance(self, number: int) -> Instance:
        """One instance. Its nodes depend on the size and ``number`` alone: they are the same in all scenarios."""
        rng = np.random.default_rng([SEED, self.n_nodes, self.n_agents, number])
        drawn = sample("uniform", rng, 1, self.n_nodes, self.n_agents, self.scenario)
        return drawn.instance(0, f"{self.scenario}-{self.size}-{number}")


@dataclass(frozen=True)
class Row:
    """One game of one method. ``parse_lines`` reads it, and checks it against these annotations.

    Attributes:
        scenario, size, instance: which instance, see ``Cell``.
        method: a key of ``METHODS``, or a file of weights.
        makespan: by ``mtsp_env.check_log``; of a game that was cut off, with the penalty.
        truncated: whether the game was cut off.
        decisions: number of decisions.
        seconds: CPU time of all decisions, with one thread; None: not measured.
        searches: a planner's number of searches, else None.
        iterations: a planner's iterations in each search, else None.
        machine: processor, cores, platform and Python version.
    """

    scenario: str
    size: str
    instance: Annotated[int, Meta(ge=0)]
    method: str
    makespan: Annotated[float, Meta(ge=0)]
    truncated: bool
    decisions: Annotated[int, Meta(ge=0)]
    seconds: Annotated[float, Meta(ge=0)] | None
    searches: Annotated[int, Meta(ge=0)] | None
    iterations: Annotated[int, Meta(ge=0)] | None
    machine: dict[str, Any]

    @property
    def key(self) -> tuple:
        """Identifies the game: a row with the same key is not played again."""
        return self.scenario, self.size, self.instance, self.method


def parse_lines(path: Path, data: bytes) -> Iterator[Row]:
    """Parse the content of a file of rows; a ValueError names ``path`` and the line."""
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            row = msgspec.json.decode(line, type=Row)
            if not math.isfinite(row.makespan):
                raise ValueError(f"makespan must be finite, got {row.makespan}")
        except (msgspec.DecodeError, ValueError) as error:
            raise ValueError(f"{path}:{number}: damaged line: {error}") from error
        yield row


# Methods

OBSERVED = "local: its open cities, and what each agent announces about itself"


@dataclass(frozen=True)
class Method:
    """How a method is called in tables, what it needs to know, and what it is.

    Exactly one of ``rule``, ``network`` and ``milliseconds`` says how it decides: a function of a random generator
    that makes a ``Decide``, weights, or a planner's time for each search.
    """

    title: str
    needs: str
    rule: Callable[[np.random.Generator], Decide] | None = None
    network: str | None = None
    milliseconds: float | None = None


def _random(rng: np.random.Generator) -> Decide:
    def decide(game: rules.State, game_rules: rules.Rules) -> int:
        legal = rules.legal_actions(game, game_rules, rules.agent_to_decide(game))[0]
        return int(rng.choice(np.flatnonzero(legal)))

    return decide


def _nearest(rng: np.random.Generator) -> Decide:
    def decide(game: rules.State, game_rules: rules.Rules) -> int:
        seen = rules.observe(game, game_rules)
        distance = np.where(seen.action_mask[0], np.hypot(*seen.cities[0].T), np.inf)
        distance[0] = 1e9  # the depot only if no city is legal
        return int(np.argmin(distance))

    return decide


METHODS: dict[str, Method] = {
    "random": Method("random", "local: its open cities", rule=_random),
    "nearest": Method("nearest city", "local: its open cities", rule=_nearest),
    "default": Method("DAN `default`, greedy", OBSERVED, network="default"),
    "joint": Method("`joint`, greedy", OBSERVED, network="joint"),
    "world": Method("`world`, greedy", OBSERVED, network="world"),
    "plan-once": Method("plan once (50 ms), then the nearest agent", "global: at the start", milliseconds=50.0),
    "replanner-5": Method("Replanner, 5 ms per event", "global: at every event", milliseconds=5.0),
    "replanner-50": Method("Replanner, 50 ms per event", "global: at every event", milliseconds=50.0),
}
BASELINE = "replanner-50"


def find_method(name: str) -> Method:
    """The method of a name in ``METHODS``, or that of a file of weights."""
    if name in METHODS:
        return METHODS[name]
    return Method(f"`{name}`, greedy", OBSERVED, network=name)


def is_available(name: str) -> bool:
    """Whether a method can be played: its network is shipped, or it has none."""
    return METHODS[name].network is None or METHODS[name].network in registry.shipped()


# Games


def play(instance: Instance, game_rules: rules.Rules, decide: Decide) -> tuple[list[int], float]:
    """The decisions of one game, and the CPU seconds that ``decide`` took for them."""
    state, decisions, seconds = rules.start(batch([instance]), game_rules), [], 0.0
    while not (rules.terminated(state) | rules.truncated(state, game_rules)).all():
        start = time.process_time()
        node = decide(state, game_rules)
        seconds += time.process_time() - start
        decisions.append(node)
        state = rules.depart(state, game_rules, np.array([node]))
    return decisions, seconds


def play_together(problem: Problem, game_rules: rules.Rules, choose: Choose) -> list[list[int]]:
    """The decisions of the games of a problem, played side by side."""
    state = rules.start(problem, game_rules)
    decisions: list[list[int]] = [[] for _ in range(len(problem.nodes))]
    while not (over := rules.terminated(state) | rules.truncated(state, game_rules)).all():
        actions = choose(state, rules.observe(state, game_rules))
        for row in np.flatnonzero(~over):
            decisions[row].append(int(actions[row]))
        state = rules.depart(state, game_rules, actions)
    return decisions


def judge(instance: Instance, game_rules: rules.Rules, decisions: list[int]) -> tuple[float, bool]:
    """The makespan of a game, and whether it was cut off.

    Raises:
        ValueError: decisions that break a rule.
    """
    problem = batch([instance])
    if len(decisions) < game_rules.max_decisions:
        return check_log(instance, write_log(problem, game_rules, decisions, close=True), game_rules.speed), False
    state = rules.start(problem, game_rules)
    for node in decisions:
        state = rules.depart(state, game_rules, np.array([node]))
    return float(rules.final_cost(state, game_rules)[0]), bool(rules.truncated(state, game_rules)[0])


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
        methods: random, nearest, default, joint, world, plan-once, replanner-5, replanner-50, or files of weights; by
            default all of those whose weights are shipped.
        scenarios: names in ``mtsp_env.SCENARIOS``.
        sizes: n and m, such as 50x5.
        out: folder for the rows, the report and the plots.

    Raises:
        OSError: no such weights, or a file that cannot be written.
        ValueError: a value outside its range, or a damaged row.
    """
    from benchmarks.reports.worlds import write_report  # imports matplotlib

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

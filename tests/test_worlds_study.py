"""The study of worlds that change: its instances, its methods, its judged rows, and the tables made from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.harness.world_rows import Row, parse_lines
from benchmarks.policies.in_worlds import METHODS, find_method
from benchmarks.studies import worlds
from benchmarks.studies.worlds import Cell, judge, play, play_together
from dan_policy import load
from dan_policy.games import chooser
from mtsp_env import Instance, makespan, mtsp_v0, rules
from mtsp_env.instance import batch

pytest.importorskip("numba", reason="needs the extra reference")
from benchmarks.policies.plan_once import PlanOnce, insert_cheaply
from benchmarks.reports.worlds import collect, gaps, makespans, write_report
from mtsp_env.reference import plan_rest

EVERYTHING = Cell("everything", 9, 3)


# Instances and games


def test_all_scenarios_have_the_same_nodes_and_a_world_of_their_own() -> None:
    plain, team = Cell("plain", 9, 3), Cell("team", 9, 3)
    for number in range(3):
        assert np.array_equal(plain.instance(number).nodes, team.instance(number).nodes)
    assert plain.instance(0) != plain.instance(1)
    assert plain.instance(0).world == ()
    assert team.instance(0).world == ("speeds",)


@pytest.mark.parametrize("scenario", ["plain", "traffic", "everything"])
def test_a_games_makespan_is_that_of_the_environment(scenario: str) -> None:
    """Nearest city, played here and in the PettingZoo environment with the same decisions."""
    cell = Cell(scenario, 9, 3)
    env = mtsp_v0.env(n_nodes=9, n_agents=3, scenario=scenario, depot="wait")
    for number in range(4):
        decisions, seconds = play(cell.instance(number), cell.rules, METHODS["nearest"].rule(None))
        assert seconds > 0
        env.reset(options={"instance": cell.instance(number)})
        for node in decisions:
            env.step(node)
        assert all(env.terminations.values())
        judged, truncated = judge(cell.instance(number), cell.rules, decisions)
        assert not truncated and judged == pytest.approx(env.unwrapped.infos["agent_0"]["makespan"], abs=1e-9)


def test_a_game_that_is_cut_off_costs_the_penalty() -> None:
    instance = Cell("plain", 5, 2).instance(0)
    short = rules.make_rules(5, 2, 0.01, "wait", "sparse", 2)
    decisions, _ = play(instance, short, METHODS["nearest"].rule(None))
    cost, truncated = judge(instance, short, decisions)
    assert truncated and len(decisions) == 2
    trips = 2 * np.linalg.norm(instance.nodes - instance.nodes[0], axis=1)
    missing = sum(trips[city] for city in {1, 2, 3, 4} - set(decisions))
    assert cost == pytest.approx(max(trips[city] for city in decisions) + missing)


def test_decisions_that_break_a_rule_are_refused() -> None:
    instance = Cell("arrivals", 9, 2).instance(0)
    unknown = int(np.argmax(instance.appears))
    others = [city for city in range(1, 9) if city != unknown]
    with pytest.raises(ValueError, match=f"decision 0: agent 0 may not go to node {unknown}"):
        judge(instance, Cell("arrivals", 9, 2).rules, [unknown, *others])


@pytest.mark.slow
def test_networks_decide_side_by_side_as_alone() -> None:
    choose = chooser(load("default"))
    instances = [EVERYTHING.instance(number) for number in range(6)]
    together = play_together(batch(instances), EVERYTHING.rules, choose)
    for instance, decisions in zip(instances, together, strict=True):
        alone, _ = play(instance, EVERYTHING.rules, lambda game, own: int(choose(game, rules.observe(game, own))[0]))
        assert alone == decisions


# Plan once


def test_where_nothing_happens_the_plan_is_the_reference_solvers() -> None:
    cell = Cell("plain", 12, 3)
    instance = cell.instance(0)
    decisions, _ = play(instance, cell.rules, PlanOnce(iterations=500))
    routes = plan_rest(instance, [0] * 3, np.zeros(3), list(range(1, 12)), iterations=500)
    planned = makespan(instance, [[0, *route, 0] for route in routes])
    assert judge(instance, cell.rules, decisions)[0] == pytest.approx(planned, abs=1e-9)


def test_a_new_city_goes_to_the_nearest_agent() -> None:
    """By hand: agents at the two ends of a line; city 3 appears beside one end, and that agent visits it."""
    nodes = [[0.5, 0.0], [0.1, 0.0], [0.9, 0.0], [0.8, 0.1]]
    instance = Instance(nodes, 2, appears=[0.0, 0.0, 0.0, 0.2])
    decisions, _ = play(instance, Cell("arrivals", 4, 2).rules, PlanOnce(iterations=100))
    assert sorted(tours_of(instance, decisions)) == [[0, 1, 0], [0, 2, 3, 0]]


def test_orphaned_cities_go_to_a_living_agent() -> None:
    """By hand: agent 0 or 1 breaks on its way to its first city; the other one visits all."""
    nodes = [[0.5, 0.5], [0.7, 0.5], [0.9, 0.5], [0.3, 0.5], [0.1, 0.5]]
    for broken in range(2):
        breaks = [np.inf, np.inf]
        breaks[broken] = 0.15
        instance = Instance(nodes, 2, breaks=breaks)
        decisions, _ = play(instance, Cell("breakdowns", 5, 2).rules, PlanOnce(iterations=100))
        tours = tours_of(instance, decisions)
        assert (tours[broken], sorted(tours[1 - broken])) == ([0], [0, 0, 1, 2, 3, 4])


def tours_of(instance: Instance, decisions: list[int]) -> list[list[int]]:
    """The tours of a game by the depot rule "wait", as the environment sees them."""
    fields = {name: array for name, array in instance.arrays().items() if name != "nodes"}
    scenario = lambda rng, batch, n, m: {name: np.stack([a] * batch) for name, a in fields.items()}  # noqa: E731
    env = mtsp_v0.raw_env(instance.n_nodes, instance.n_agents, scenario=scenario, depot="wait")
    env.reset(options={"instance": instance})
    for node in decisions:
        env.step(node)
    return env.tours


def test_a_city_is_inserted_where_the_detour_is_shortest() -> None:
    nodes = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.0], [1.0, 0.5], [0.5, 0.5]])
    for city, expected in ((3, [3, 1, 2]), (4, [1, 4, 2]), (5, [1, 2, 5])):
        route = [1, 2]
        insert_cheaply(route, city, 0, nodes)
        assert route == expected


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["plain", "arrivals", "breakdowns", "traffic", "team", "service", "everything"])
def test_plan_once_plays_every_scenario_to_the_end(scenario: str) -> None:
    for n, m in ((2, 3), (9, 2), (12, 5)):
        cell = Cell(scenario, n, m)
        for number in range(5):
            decisions, _ = play(cell.instance(number), cell.rules, PlanOnce(iterations=20))
            assert not judge(cell.instance(number), cell.rules, decisions)[1]


# Rows and tables


def row(method: str, number: int, value: float, scenario: str = "plain") -> Row:
    return Row(scenario, "9x3", number, method, value, False, 12, 0.5, None, None, {})


def test_gaps_are_paired() -> None:
    """Instance 2 has no game of the baseline, so it counts in the mean makespan alone."""
    rows = [row("replanner-50", 0, 2.0), row("replanner-50", 1, 4.0)]
    rows += [row("nearest", number, value) for number, value in enumerate([3.0, 4.0, 8.0])]
    games = collect(rows)
    assert list(games) == ["nearest", "replanner-50"]
    assert "| nearest city | 5.000 ± 1.528 |" in makespans(games, "9x3")
    assert "| Replanner, 50 ms per event | 3.000 ± 1.000 (2) |" in makespans(games, "9x3")
    assert "| nearest city | 25.0 ± 25.0 |" in gaps(games, "9x3")


@pytest.mark.slow
def test_the_command_from_end_to_end(tmp_path: Path, capsys, monkeypatch) -> None:
    command = ["worlds", "--sizes", "6x2", "--scenarios", "plain", "everything", "--out", str(tmp_path)]
    methods = ["--methods", "random", "nearest", "default", "plan-once", "replanner-5", "replanner-50"]
    assert main([*command, *methods, "--instances", "2"]) == 0
    rows = list(parse_lines(tmp_path / "rows.jsonl", (tmp_path / "rows.jsonl").read_bytes()))
    assert len({each.key for each in rows}) == len(rows) == 6 * 2 * 2
    assert all((each.searches is None) == (each.method in ("random", "nearest", "default")) for each in rows)
    report = (tmp_path / "report.md").read_text()
    assert "| `default`, greedy" in report and "| everything |" in report
    assert (tmp_path / "6x2.png").stat().st_size > 5000

    assert main([*command, "--methods", "replanner-5", "--instances", "3"]) == 0
    more = list(parse_lines(tmp_path / "rows.jsonl", (tmp_path / "rows.jsonl").read_bytes()))
    assert more[: len(rows)] == rows and len(more) == len(rows) + 2
    assert len({each.iterations for each in more if (each.scenario, each.method) == ("plain", "replanner-5")}) == 1
    monkeypatch.setattr(worlds, "play", lambda *_: pytest.fail("a game of the file was played again"))
    assert main([*command, "--methods", "replanner-5", "random", "--instances", "2"]) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sizes", "50"], "sizes must be such as 50x5, got '50'"),
        (["--scenarios", "rain"], "unknown scenario 'rain'"),
        (["--instances", "0"], "instances must be a whole number of at least 1, got 0"),
        (["--methods", "magic"], "magic"),
    ],
)
def test_bad_options_are_named(options: list[str], message: str, tmp_path: Path, capsys) -> None:
    assert main(["worlds", *options, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("line", [b"{}", b"not JSON", b'{"makespan": -1}'])
def test_damaged_rows_are_named(line: bytes, tmp_path: Path) -> None:
    (tmp_path / "rows.jsonl").write_bytes(line + b"\n")
    with pytest.raises(ValueError, match=r"rows.jsonl:1: damaged line"):
        write_report(tmp_path)


def test_a_network_of_ones_own_is_a_method() -> None:
    own = find_method("runs/mine.safetensors")
    assert own == replace(METHODS["default"], title="`runs/mine.safetensors`, greedy", network=own.network)

"""LKH's tours solve the instance; its processes end in time, and with their parents."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from benchmarks.solvers import NoTours, Unavailable, lkh3
from benchmarks.solvers._two_index import greedy_makespan
from benchmarks.suite import Cell
from mtsp_env import Instance, check_tours, makespan

needs_lkh = pytest.mark.skipif(
    shutil.which("LKH") is None and find_spec("elkai") is None, reason="needs LKH or the package elkai"
)
needs_posix = pytest.mark.skipif(os.name != "posix", reason="the program that stands in for LKH is a script")

# Stands in for LKH: writes the tours in its orders, then ends as they say; it ignores SIGTERM
PROGRAM = """#!{python}
import json, os, signal, sys, time
from pathlib import Path

signal.signal(signal.SIGTERM, signal.SIG_IGN)
orders = json.loads(Path({orders!r}).read_text())
for name, text in orders["files"].items():
    Path(name).write_text(text)
seen = {{"pid": os.getpid(), "parameters": Path(sys.argv[1]).read_text(), "problem": Path("problem").read_text()}}
Path({seen!r} + ".tmp").write_text(json.dumps(seen))
Path({seen!r} + ".tmp").rename({seen!r})
if orders["hangs"]:
    time.sleep(600)
print("*** Error ***", file=sys.stderr)
sys.exit(orders["code"])
"""


def tour_file(*numbers: int, complete: bool = True) -> str:
    text = "\n".join(["TYPE : TOUR", "TOUR_SECTION", *map(str, numbers), "-1", "EOF", ""])
    return text if complete else text[:-13]  # cut off within the nodes


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A function that puts a stand-in for LKH on the PATH; it returns the file with what the stand-in has seen."""

    def install(files: dict[str, str] | None = None, hangs: bool = False, code: int = 0) -> Path:
        seen, orders, program = tmp_path / "seen", tmp_path / "orders", tmp_path / "LKH"
        orders.write_text(json.dumps({"files": files or {}, "hangs": hangs, "code": code}))
        program.write_text(PROGRAM.format(python=sys.executable, orders=str(orders), seen=str(seen)))
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path))
        return seen

    return install


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@needs_lkh
@pytest.mark.slow
def test_three_tiny_instances_are_solved_within_the_time_limit():
    for instance in Cell(8, 2, 3).instances(0):
        start = time.perf_counter()
        tours = lkh3.solve(instance, 1.0, 0)
        assert time.perf_counter() - start < 1.2 * 1.0 + 0.5
        check_tours(instance, tours)


@pytest.mark.slow
@needs_lkh
def test_equal_seeds_and_trials_give_equal_tours():
    instance = Cell(20, 3, 1).instances(0)[0]
    first, again, other = (lkh3.solve(instance, 60.0, seed, trials=2) for seed in (3, 3, 4))
    assert first == again != other


@needs_lkh
def test_one_agent_is_a_travelling_salesman():
    instance = Cell(60, 1, 1).instances(0)[0]  # LKH's first bound is not the optimum, so it searches
    tours = lkh3.solve(instance, 10.0, 0, trials=10)
    check_tours(instance, tours)
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2)
    assert makespan(instance, tours) < greedy_makespan(distance, 1)


@needs_lkh
def test_the_square_is_solved_to_its_optimum(square):
    assert makespan(square, lkh3.solve(square, 10.0, 0, trials=20)) == pytest.approx(2.0)


TINY = {
    "n = 2": ([[0, 0], [0, 1]], 1, 2.0),
    "n = 2, idle agents": ([[0, 0], [0, 1]], 4, 2.0),
    "n = 3, one agent": ([[0, 0], [0, 1], [1, 0]], 1, 2.0 + 2.0**0.5),
    "as many agents as cities": ([[0, 0], [0, 1], [1, 0], [0.5, 0]], 3, 2.0),
    "more agents than cities": ([[0, 0], [0, 1], [1, 0]], 5, 2.0),
    "all in one place": ([[0.5, 0.5]] * 6, 2, 0.0),
    "cities in one place": ([[0, 0]] + [[0, 1]] * 4 + [[1, 0]] * 3, 2, 2.0),
    "cities on the depot": ([[0, 0]] * 4 + [[0, 1]] * 2, 2, 2.0),
    "on a line": ([[0, x / 4] for x in range(5)], 2, 2.0),
}


@needs_lkh
@pytest.mark.parametrize("name", TINY)
def test_odd_instances_are_solved(name):
    nodes, n_agents, optimum = TINY[name]
    instance = Instance(nodes, n_agents)
    tours = lkh3.solve(instance, 10.0, 0, trials=20)
    check_tours(instance, tours)
    assert makespan(instance, tours) == pytest.approx(optimum, abs=1e-12)


@pytest.mark.slow
@needs_posix
def test_the_best_complete_tours_are_read_when_time_is_up(stand_in, square):
    files = {
        "5_5.tour": tour_file(1, 2, 3, 4, 5, 6, 7, 8),  # 8 is the depot again: one agent visits every city
        "2_4.tour": tour_file(4, 1, 7, 6, 5, 8, 3, 2),
        "1_1.tour": tour_file(1, 2, 3, 4, 8, 5, 6, 7, complete=False),
    }
    seen = stand_in(files, hangs=True)
    start = time.perf_counter()
    tours = lkh3.solve(square, 1.0, 0)
    assert time.perf_counter() - start < 1.2 * 1.0 + 0.5
    assert tours == [[0, 6, 5, 4, 0], [0, 2, 1, 3, 0]]
    assert is_gone(json.loads(seen.read_text())["pid"])


@pytest.mark.slow
@needs_posix
def test_no_tours_in_time_raise(stand_in, square):
    stand_in(hangs=True)
    with pytest.raises(NoTours, match=r"not done in 0\.1 s"):
        lkh3.solve(square, 0.1, 0)


@needs_posix
def test_a_failure_of_lkh_is_reported_with_its_message(stand_in, square):
    stand_in({"2_4.tour": tour_file(1, 4, 3, 2, 8, 5, 6, 7)}, code=3)
    with pytest.raises(RuntimeError, match=r"LKH ended with code 3: \*\*\* Error \*\*\*"):
        lkh3.solve(square, 30.0, 0)


@needs_posix
def test_lkh_is_given_the_instance(stand_in):
    seen = stand_in({"x.tour": tour_file(1, 2, 4, 3)})
    nodes = [[0.5, 0.25], [0.5, 1.0], [0.1234567, 0.0]]
    assert lkh3.solve(Instance(nodes, 9), 30.0, 41) == [[0, 1, 0], [0, 2, 0]] + [[0, 0]] * 7
    seen = json.loads(seen.read_text())
    parameters = dict(line.split(" = ") for line in seen["parameters"].splitlines() if " = " in line)
    assert parameters["SALESMEN"] == "2"  # at most as many as cities
    assert parameters["OPTIMUM"] == "1500000"  # out and back, in millionths
    assert parameters["SEED"] == "42" and parameters["MTSP_OBJECTIVE"] == "MINMAX"
    assert 0 < float(parameters["TOTAL_TIME_LIMIT"]) <= 30.0
    assert seen["problem"].partition("NODE_COORD_SECTION\n")[2].split("\n")[:3] == [
        "1 500000 250000",
        "2 500000 1000000",
        "3 123457 0",
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can end a process with its parent")
@pytest.mark.slow
def test_lkh_ends_with_a_killed_parent(stand_in):
    seen = stand_in(hangs=True)
    code = (
        "from benchmarks.solvers import lkh3; from mtsp_env import Instance;"
        "lkh3.solve(Instance([[0, 0], [0, 1], [1, 0], [1, 1]], 2), 600.0, 0)"
    )
    environment = os.environ | {"TMPDIR": str(seen.parent)}  # a killed parent removes no files
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[1], env=environment)
    try:
        wait_for(seen.exists)
        pid = json.loads(seen.read_text())["pid"]
        assert not is_gone(pid)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    wait_for(lambda: is_gone(pid))


def wait_for(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still false after {seconds} s"
        time.sleep(0.01)


def test_a_missing_lkh_is_unavailable(square, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(lkh3, "find_spec", lambda name: None)
    with pytest.raises(Unavailable, match="neither the program LKH nor the package elkai"):
        lkh3.solve(square, 1.0, 0)


def test_tours_are_cut_at_the_depot_and_its_copies():
    instance = Instance(np.random.default_rng(0).random((6, 2)), 4)
    text = tour_file(5, 7, 2, 3, 1, 6, 8, 4)  # 7 and 8: the depot again
    assert lkh3._read(text, instance) == [[0, 1, 2, 0], [0, 5, 0], [0, 3, 4, 0], [0, 0]]

"""Input that must not pass silently: wrong kinds of numbers, sizes, files that never end, text for the terminal."""

import json
import math
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from command import refused, run
from made_up import one_agent_does_it_all, row

from benchmarks import best_known, suite
from benchmarks.__main__ import main as benchmarks
from benchmarks.harness import rows
from dan_policy import planning, solve
from dan_policy.cli import main
from mtsp_env import Instance, check_tours, machine, makespan, read_tsplib, uniform
from mtsp_env.files import read_instance
from mtsp_env.instance import from_coordinates
from mtsp_env.reading import printable, read_file
from mtsp_env.tours import check_prefixes

pytest.importorskip("vrplib", reason="needs the extra tsplib")
ROOT = Path(__file__).parents[1]
TSP = "DIMENSION: 2\nEDGE_WEIGHT_TYPE: EUC_2D\nNODE_COORD_SECTION\n1 0 0\n2 3 4\nEOF\n"

# Values


@pytest.mark.parametrize("value", ["0.5", True, b"1", np.True_, None])
def test_coordinates_are_numbers(tmp_path, value) -> None:
    with pytest.raises(ValueError, match="nodes must be"):
        Instance([[0.0, 0.0], [0.5, value]], 1)
    with pytest.raises(ValueError, match="coordinates must be"):
        from_coordinates([[0.0, 0.0], [0.5, value]], 1)
    if not isinstance(value, (bytes, np.bool_)):
        path = tmp_path / "a.json"
        path.write_text(json.dumps({"n_agents": 1, "nodes": [[0.0, 0.0], [0.5, value]]}))
        with pytest.raises(ValueError, match=r"a\.json: nodes must be"):
            read_instance(path)


def test_arrays_of_coordinates_are_numbers() -> None:
    for array in (np.array([["0", "0"], ["0.5", "1"]]), np.eye(2, dtype=bool)):
        with pytest.raises(ValueError, match="nodes must be an array of numbers"):
            Instance(array, 1)


@pytest.mark.parametrize("node", [1.9, 1.0, "1", True, None])
def test_prefixes_are_whole_numbers(square: Instance, node) -> None:
    with pytest.raises(ValueError, match=r"prefix 1 must be a list of node numbers, got .* in it"):
        check_prefixes(square, [[0], [0, node]])


def test_lengths_never_overflow() -> None:
    with pytest.raises(ValueError, match="coordinates must span at most"):
        from_coordinates([[-1e308, 0.0], [1e308, 1e308]], 1)
    with pytest.raises(ValueError, match="scale must be at most"):
        Instance([[0.0, 0.0], [1.0, 1.0]], 1, scale=1e308)
    with pytest.raises(ValueError, match="scale must be a finite number above 0, got True"):
        Instance([[0.0, 0.0], [1.0, 1.0]], 1, scale=True)
    largest = sys.float_info.max / 4
    instance = from_coordinates([[0.0, 0.0], [largest, largest]], 1)
    assert math.isfinite(makespan(instance, [[0, 1, 0]]) * instance.scale)


# Files


def test_a_byte_order_mark_is_skipped(tmp_path) -> None:
    path, other = tmp_path / "a.tsp", tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbfNAME: plain\n" + TSP.encode())
    assert read_tsplib(path, 1).name == "plain"
    other.write_bytes(b"\xef\xbb\xbf" + json.dumps({"n_agents": 1, "nodes": [[0, 0], [1, 1]]}).encode())
    assert read_instance(other).n_nodes == 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_not_a_regular_file_is_refused_before_it_is_opened(tmp_path, capsys, kind: str) -> None:
    for suffix in (".tsp", ".json", ".jsonl"):
        path = tmp_path / f"input{suffix}"
        {"pipe": os.mkfifo, "device": lambda p: p.symlink_to("/dev/zero"), "folder": Path.mkdir}[kind](path)
        message = "a directory, not a file" if kind == "folder" else "not a regular file"
        if suffix == ".jsonl":
            assert benchmarks(["report", str(path)]) == 2
            assert message in capsys.readouterr().err
        else:
            assert message in refused(capsys, "solve", str(path), "--agents", "2")


def test_a_file_that_does_not_fit_into_the_memory_is_refused(tmp_path, monkeypatch) -> None:
    path = tmp_path / "large.json"
    with open(path, "wb") as file:
        file.truncate(2**27)  # takes no space on the disk
    monkeypatch.setattr(machine, "available_memory", lambda: 2**28)
    with pytest.raises(ValueError, match=r"large\.json: the size in bytes 134217728 needs about 1 GiB"):
        read_file(path)


# Sizes


@pytest.mark.slow
def test_agents_beyond_the_cities_take_no_part_in_games(monkeypatch) -> None:
    instance = uniform(np.random.default_rng(5), 20, 10_000)
    played = []
    begin = planning.begin
    monkeypatch.setattr(planning, "begin", lambda team, *more: played.append(team.n_agents) or begin(team, *more))
    few = solve(replace(instance, n_agents=19), _nearest, device="cpu")
    many = solve(instance, _nearest, device="cpu")
    assert played == [19, 19]
    assert many.tours == few.tours + [[0, 0]] * (10_000 - 19)
    check_tours(instance, many.tours)


def _nearest(cities, action_mask):
    return -cities.norm(dim=-1)


_nearest.in_keys = ["cities", "action_mask"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("generate --nodes 1000000000 --agents 2 a.json", "nodes 1000000000 needs about 466 GiB of memory"),
        ("generate --nodes 5 --agents 100000000 a.json", "must be a whole number from 1 to 100000, got '100000000'"),
    ],
)
def test_sizes_that_cannot_be_are_refused(folder, capsys, monkeypatch, argv: str, message: str) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 2**30)
    assert message in refused(capsys, *argv.split())


def test_too_many_games_agents_and_instances_are_refused(square: Instance, monkeypatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 2**30)
    with pytest.raises(ValueError, match=r"samples 100000000 needs about .* at most 1193046 fits"):
        solve(square, _nearest, decode="sample", samples=100_000_000, device="cpu")
    with pytest.raises(ValueError, match="n_agents 100000000 needs about"):
        solve(replace(square, n_agents=100_000_000), _nearest, device="cpu")
    with pytest.raises(ValueError, match="instances must be at most 10000, got 1000000000"):
        suite.cells("smoke", count=10**9)


# Rows

INSTANCE = suite.cells("smoke")[0].instances(7)[0]
ROW = row(INSTANCE, one_agent_does_it_all(INSTANCE), 0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("instance", value) for value in (0.5, -1, 10**9, "0", True, None)),
        *(("seed", value) for value in (7.5, True, -1, None)),
        *((name, None) for name in ("versions", "machine", "name", "seconds", "makespan", "tours")),
        ("makespan", math.nan),
        ("makespan", math.inf),
        ("seconds", -1.0),
        ("budget", "1"),
        ("tours", [[0, 1.5, 0]]),
        ("versions", {"numpy": 2}),
        ("status", "fine"),
        ("status", "error"),
        ("makespan", 0.1),
        ("tours", [[0, 0], [0, 0]]),
    ],
)
def test_a_bad_row_is_named_by_report_and_merge(tmp_path, capsys, monkeypatch, field: str, value) -> None:
    monkeypatch.setattr(best_known.merge_rows, "__defaults__", (None, tmp_path / "best"))
    path = tmp_path / "rows.jsonl"
    path.write_text("".join(json.dumps(asdict(ROW) | more) + "\n" for more in ({}, {field: value})))
    for command in (["report", str(path)], ["best", "--merge", str(path)]):
        assert benchmarks(command) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err.startswith(f"benchmarks: error: {path}:2: ")
        assert printed.err.count("\n") == 1
    assert not (tmp_path / "best").exists()


def test_a_good_row_is_read_as_it_was_written() -> None:
    assert rows.parse(json.dumps(asdict(ROW))) == ROW


# Processes and terminals


def test_control_characters_are_not_printed(folder, capsys) -> None:
    assert printable("a\x1b[31mé\udcff\n") == "a\ufffd[31mé\ufffd\ufffd"
    Path("a.tsp").write_text("NAME: \x1b]0;title\x07red\n" + TSP)
    assert main(["solve", "a.tsp", "--agents", "1", "--method", "reference"]) == 0
    out = capsys.readouterr().out
    assert "\ufffd]0;title\ufffdred: 1 cities, 1 agents" in out and "\x1b]" not in out
    assert "\x1b" not in refused(capsys, "solve", "\x1b[31m.tsp", "--agents", "1")


@pytest.mark.slow
def test_in_a_folder_that_is_gone_the_command_works_with_whole_paths(tmp_path) -> None:
    gone = tmp_path / "gone"
    code = (
        f"import os, sys; os.chdir({str(gone)!r}); os.rmdir({str(gone)!r}); sys.path.insert(0, {str(ROOT)!r})\n"
        "from dan_policy.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    for path, code_expected in ((str(tmp_path / "a.json"), 0), ("a.json", 2)):
        gone.mkdir()
        command = [sys.executable, "-c", code, "generate", "--nodes", "5", "--agents", "2", path]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == code_expected and done.stderr.count("\n") == (code_expected > 0)


def test_a_loop_of_links_is_refused(folder, capsys) -> None:
    Path("loop.json").symlink_to("loop.json")
    with pytest.raises(SystemExit) as caught:
        main(["solve", "square.json", "--method", "reference", "--out", "loop.json"])
    assert caught.value.code == 2
    assert "loop.json: cannot write it" in capsys.readouterr().err


@pytest.mark.slow
def test_half_a_character_in_a_file_name_is_printed(tmp_path) -> None:
    done = run("generate", "--nodes", "5", "--agents", "2", os.fsdecode(os.fsencode(tmp_path) + b"/\xff.json"))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("wrote ")

"""The command ``mtsp``: what it prints and writes; every bad input gives one line and exit code 2."""

import io
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import refused

import dan_policy
from dan_policy.cli import main
from mtsp_env import (
    Instance,
    __version__,
    makespan,
    read_instance,
    read_tours,
    uniform,
    write_instance,
)

pytest.importorskip("rich", reason="needs the extra dan")
pytest.importorskip("vrplib", reason="needs the extra tsplib")
pytest.importorskip("matplotlib", reason="needs the extra render")

EUROPE = Path(__file__).parent.parent / "examples" / "europe.tsp"


class FakeSolve:
    """Takes the place of ``dan_policy.solve``: deals the cities out in turn, and keeps the options of its calls."""

    def __init__(self):
        self.calls: list[dict] = []

    def __call__(self, instance: Instance, **options) -> SimpleNamespace:
        self.calls.append(options)
        cities, m = list(range(1, instance.n_nodes)), instance.n_agents
        tours = [[0, *cities[agent::m], 0] for agent in range(m)]
        return SimpleNamespace(tours=tours, makespan=makespan(instance, tours), seconds=0.25, method="fake")


@pytest.fixture
def solver(monkeypatch) -> FakeSolve:
    fake = FakeSolve()
    monkeypatch.setitem(vars(dan_policy), "solve", fake)
    return fake


# mtsp solve


def test_json_is_the_judges_verdict_in_the_units_of_the_file(folder, solver, capsys) -> None:
    assert main(["solve", "ten.tsp", "--agents", "2", "--json"]) == 0
    printed = capsys.readouterr()
    record = json.loads(printed.out)
    assert printed.err == ""
    assert list(record) == [
        *("name", "n_nodes", "n_agents", "method", "seconds", "makespan", "lower_bound", "lengths", "times", "tours")
    ]
    assert (record["name"], record["n_nodes"], record["n_agents"], record["method"]) == ("ten", 7, 2, "fake")
    assert record["seconds"] == 0.25
    assert record["tours"] == [[0, 1, 3, 5, 0], [0, 2, 4, 6, 0]]
    across, side, diagonal = 50**0.5, 5.0, 10 * 1.25**0.5  # half a diagonal; half a side; corner to far middle
    by_hand = [across + side + diagonal + across, side + 10.0 + across + side]
    assert record["lengths"] == record["times"] == pytest.approx(by_hand)
    assert record["makespan"] == pytest.approx(max(by_hand))
    assert record["lower_bound"] == pytest.approx(15.0)
    assert solver.calls == [
        {
            "policy": "default",
            "decode": "greedy",
            "samples": 64,
            "seed": 0,
            "device": "cpu",
            "improve": None,
            "precision": "auto",
            "view": None,
            "augment": False,
            "reconstruct": 0,
        }
    ]  # the defaults that --help names


def test_options_reach_the_solver(folder, solver) -> None:
    options = "--policy a.safetensors --decode sample --samples 7 --seed 5 --device cuda:1 --improve .5 --json"
    options += " --precision float32 --augment --reconstruct 3 --view 30"
    assert main(["solve", "square.json", *options.split()]) == 0
    assert solver.calls == [
        {
            "policy": "a.safetensors",
            "decode": "sample",
            "samples": 7,
            "seed": 5,
            "device": "cuda:1",
            "improve": 0.5,
            "precision": "float32",
            "view": 30,
            "augment": True,
            "reconstruct": 3,
        }
    ]


@pytest.fixture
def improved(monkeypatch) -> list[dict]:
    """The options of calls to the reference solver, whose search takes no time."""
    reference, calls = pytest.importorskip("mtsp_env.reference", reason="needs the extra reference"), []

    def improve(instance: Instance, **options) -> list[list[int]]:
        calls.append(options)
        return [[0, *range(1, instance.n_nodes), 0], *[[0, 0]] * (instance.n_agents - 1)]

    monkeypatch.setattr(reference, "improve", improve)
    return calls


@pytest.mark.slow
def test_the_reference_solves_in_the_policys_place(folder, solver, improved, capsys) -> None:
    assert main(["solve", "square.json", "ten.tsp", "--agents", "2", "--json", "--method", "reference"]) == 0
    assert main(["solve", "square.json", "--json", "--method", "reference", "--seconds", "1.5", "--seed", "8"]) == 0
    assert improved == [{"seconds": None, "seed": 0}] * 2 + [{"seconds": 1.5, "seed": 8}]
    assert solver.calls == []
    for line in capsys.readouterr().out.splitlines():
        record = json.loads(line)
        assert record["method"] == "reference"
        assert record["tours"] == [[0, 1, 2, 3, 4, 5, 6, 0], [0, 0]]
        assert record["seconds"] > 0


def test_agents_of_a_json_file_are_its_own_unless_given(folder, solver, capsys) -> None:
    for argv, expected in ((["square.json"], 2), (["square.json", "--agents", "9"], 9)):
        assert main(["solve", *argv, "--json"]) == 0
        assert len(json.loads(capsys.readouterr().out)["tours"]) == expected


def test_table_names_every_agent_and_what_the_longest_tour_is_worth(folder, solver, capsys) -> None:
    assert main(["solve", "ten.tsp", "--agents", "2"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "ten: 6 cities, 2 agents" in lines
    assert "0 3 30.32 100% 0 1 3 5 0" in lines
    assert "1 3 27.07 89% 0 2 4 6 0" in lines
    assert "makespan 30.32; at most 102.1% above the best possible (lower bound 15.00)" in lines
    assert "fake in 0.25 s" in lines


def test_table_fits_the_terminal_and_shows_both_ends_of_long_tours(folder, solver, capsys) -> None:
    assert main(["solve", str(EUROPE), "--agents", "1"]) == 0
    out = capsys.readouterr().out
    row = next(line.split() for line in out.splitlines() if line.startswith("      0"))
    assert row[:2] == ["0", "51"]
    dots = row.index("...")
    assert row[4:7] == ["0", "1", "2"]
    assert row[-3:] == ["50", "51", "0"]
    assert dots - 4 >= len(row) - dots - 1 > 2
    assert max(len(line) for line in out.splitlines()) <= 80


def test_names_are_text_not_markup(folder, solver, capsys) -> None:
    write_instance("odd.json", Instance([[0.0, 0.0], [1.0, 1.0]], 1, name="[red]a[/red] [b"))
    assert main(["solve", "odd.json"]) == 0
    assert "[red]a[/red] [b: 1 cities" in capsys.readouterr().out


def test_all_nodes_in_one_place_and_idle_agents(folder, solver, capsys) -> None:
    write_instance("spot.json", Instance([[0.5, 0.5]] * 3, 5))
    assert main(["solve", "spot.json", "--plot", "spot.png"]) == 0
    out = capsys.readouterr().out
    assert "makespan 0; the best possible" in out
    assert out.endswith("wrote spot.png\n")


def test_files_hold_what_was_printed(folder, solver, capsys) -> None:
    assert main(["solve", "ten.tsp", "--agents", "2", "--json", "--out", "tours.json", "--plot", "tours.svg"]) == 0
    record = json.loads(capsys.readouterr().out)  # and nothing else
    assert json.loads(Path("tours.json").read_text()) == record
    assert read_tours("tours.json") == record["tours"]
    assert Path("tours.svg").read_bytes().startswith(b"<?xml")


@pytest.mark.slow
def test_animations_and_pages_show_what_was_printed(folder, solver, capsys) -> None:
    assert main(["solve", "ten.tsp", "--agents", "2", "--json", "--animate", "a.gif", "--html", "a.html"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert Path("a.gif").read_bytes().startswith(b"GIF89a")
    page = Path("a.html").read_text()
    assert f"makespan {record['makespan']:.2f}" in page
    assert "fake in 0.25 s." in page
    assert "No makespan can be below 15.00." in page


@pytest.mark.slow
def test_a_teams_tours_have_their_times_everywhere(folder, solver, square: Instance, capsys) -> None:
    """Agent 1 is half as fast, so that its tour, though as long as the other, takes twice the time."""
    write_instance("team.json", Instance(square.nodes, 2, speeds=[1.0, 0.5], name="team"))
    assert main(["solve", "team.json", "--animate", "a.gif", "--html", "a.html", "--out", "tours.json"]) == 0
    record = json.loads(Path("tours.json").read_text())
    assert record["times"] == pytest.approx([record["lengths"][0], 2 * record["lengths"][1]])
    assert record["makespan"] == max(record["times"])
    printed = capsys.readouterr().out
    assert re.search(r"length +time +share", printed)
    assert f"makespan {record['makespan']:.3f};" in printed
    assert "100%" in printed
    page = Path("a.html").read_text()
    assert f"makespan {record['makespan']:.3f}" in page
    assert '"lastColumn": "home at"' in page
    assert '"longest": 1' in page


@pytest.mark.slow
def test_several_files_get_their_names_into_the_outputs(folder, solver, capsys) -> None:
    Path("again.tsp").write_text(Path("ten.tsp").read_text())
    write_instance("slash.json", Instance([[0.0, 0.0], [1.0, 1.0]], 1, name="../a b"))
    write_instance("blank.json", Instance([[0.0, 0.0], [1.0, 1.0]], 1))
    files = ["ten.tsp", "square.json", "again.tsp", "slash.json", "blank.json"]
    inputs = set(folder.iterdir())
    assert main(["solve", *files, "--agents", "2", "--json", "--out", "t.json", "--plot", "t.png"]) == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [record["name"] for record in records] == ["ten", "square", "ten", "../a b", ""]
    stems = ["t-ten", "t-square", "t-ten-2", "t-.._a_b", "t-instance"]
    assert {path.name for path in set(folder.iterdir()) - inputs} == {
        f"{s}{e}" for s in stems for e in (".json", ".png")
    }
    assert [json.loads(Path(f"{stem}.json").read_text()) for stem in stems] == records


def test_it_says_where_the_files_are(folder, solver, capsys) -> None:
    assert main(["solve", "square.json", "--out", "t.json", "--plot", "t.png"]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == ["wrote t.json", "wrote t.png"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("nowhere.tsp --agents 2", "nowhere.tsp: No such file or directory"),
        ("nowhere.json", "nowhere.json: No such file or directory"),
        ("square.txt", "square.txt: unknown suffix '.txt'; choose from ['.json', '.tsp']"),
        ("ten.tsp", "ten.tsp: a TSPLIB file does not say how many agents there are; add --agents"),
        ("junk.tsp --agents 2", "junk.tsp: not a TSPLIB file"),
        ("junk.json", "junk.json: not a JSON file"),
        ("square.json nowhere.json", "nowhere.json: No such file"),
        ("square.json --agents 0", "--agents: must be a whole number from 1 to 100000, got '0'"),
        ("square.json --agents two", "--agents: must be a whole number from 1 to 100000, got 'two'"),
        ("square.json --agents 2.5", "got '2.5'"),
        ("square.json --decode sample --samples -3", "--samples: must be a whole number of at least 1, got '-3'"),
        ("square.json --samples 3", "--samples needs --decode sample"),
        (
            "square.json --method lkh",
            "invalid choice 'lkh' for argument '--method'",
        ),
        ("square.json --improve 0", "--improve: must be a finite number of seconds above 0, got '0'"),
        ("square.json --improve inf", "must be a finite number of seconds above 0, got 'inf'"),
        ("square.json --improve soon", "must be a finite number of seconds above 0, got 'soon'"),
        ("square.json --seconds 1", "--seconds needs --method reference"),
        ("square.json --method reference --seconds -1", "--seconds: must be a finite number of seconds above 0"),
        ("square.json --method reference --improve 1", "--improve needs --method dan"),
        ("square.json --method reference --policy default", "--policy needs --method dan"),
        ("square.json --method reference --decode greedy", "--decode needs --method dan"),
        ("square.json --method reference --samples 64", "--samples needs --method dan"),
        ("square.json --method reference --device cpu", "--device needs --method dan"),
        ("square.json --seed -1", "--seed: must be a whole number of at least 0, got '-1'"),
        ("square.json --seed 9223372036854775808", "--seed: must be"),
        ("square.json --decode beam", "invalid choice 'beam' for argument '--decode'"),
        ("square.json --plot t.xyz", "t.xyz: unknown picture suffix 'xyz'"),
        ("square.json --animate t.png", "t.png: unknown animation suffix '.png'; choose from ['.gif', '.mp4']"),
        ("square.json --html t.pdf", "t.pdf: unknown suffix '.pdf'; choose from ['.html', '.htm']"),
        ("square.json --html nowhere/t.html", "nowhere/t.html: no such folder"),
        ("square.json --plot nowhere/t.png", "nowhere/t.png: no such folder"),
        ("square.json --out nowhere/t.json", "nowhere/t.json: no such folder"),
        ("square.json --out square.json", "square.json: would overwrite another file of this command"),
        ("square.json --out t.svg --plot ./t.svg", "t.svg: would overwrite another file of this command"),
        ("", "required: FILE"),
        ("square.json --sample 3", "Unrecognized options: --sample, 3"),
        ("square.json --agents", "Missing value for argument '--agents'"),
        ("square.json --method reference --network mine:net", "--network needs --method dan"),
        ("square.json --network nowhere_at_all:net", "No module named 'nowhere_at_all'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_solved(folder, solver, capsys, argv: str, message: str) -> None:
    Path("junk.tsp").write_bytes(b"\x00\xffjunk\n")
    Path("junk.json").write_bytes(b"\x00\xffjunk\n")
    before = sorted(folder.iterdir())
    assert message in refused(capsys, "solve", *argv.split())
    assert solver.calls == []
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("option", ["--plot", "--out"])
def test_an_output_that_cannot_be_written(folder, solver, capsys, option: str) -> None:
    Path("taken.png").mkdir()
    with pytest.raises(SystemExit) as caught:
        main(["solve", "square.json", "--json", option, "taken.png"])
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.err.startswith("mtsp: error: taken.png: cannot write it (")
    assert printed.err.count("\n") == 1
    assert json.loads(printed.out)["name"] == "square"  # what was solved is not lost
    assert not [path for path in folder.iterdir() if path.suffix == ".tmp"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (FileNotFoundError("no weights at mine; shipped are ['default']"), "no weights at mine; shipped are"),
        (ValueError("bad\nweights"), "bad weights"),
        (ImportError("no torch"), "no torch"),
    ],
)
def test_what_the_solver_refuses_is_one_line_too(folder, monkeypatch, capsys, error: Exception, message: str) -> None:
    def solve(*_, **__):
        raise error

    monkeypatch.setitem(vars(dan_policy), "solve", solve)
    assert message in refused(capsys, "solve", "square.json", "--policy", "mine")


def test_an_interrupt_is_quiet(folder, monkeypatch, capsys) -> None:
    def solve(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setitem(vars(dan_policy), "solve", solve)
    assert main(["solve", "square.json"]) == 130
    assert capsys.readouterr() == ("", "")


# mtsp generate


@pytest.mark.parametrize("distribution", ["uniform", "clustered"])
def test_generate_writes_the_same_instance_for_the_same_seed(folder, capsys, distribution: str) -> None:
    for seed, path in ((4, "a.json"), (4, "b.json"), (5, "c.json")):
        argv = f"generate --nodes 20 --agents 3 --seed {seed} --distribution {distribution} {path}"
        assert main(argv.split()) == 0
        assert capsys.readouterr() == (f"wrote {path}\n", "")
    a, b, c = (read_instance(path) for path in ("a.json", "b.json", "c.json"))
    assert a == b != c
    assert (a.n_nodes, a.n_agents, a.name) == (20, 3, f"{distribution}-20-4")
    assert not np.array_equal(a.nodes, c.nodes)


def test_generate_defaults_are_the_papers(folder) -> None:
    assert main(["generate", "--nodes", "20", "--agents", "3", "a.json"]) == 0
    assert read_instance("a.json").nodes.tolist() == uniform(np.random.default_rng(0), 20, 3).nodes.tolist()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--nodes 1 --agents 2 a.json", "--nodes: must be a whole number of at least 2, got '1'"),
        ("--nodes 5 --agents 0 a.json", "--agents: must be a whole number from 1 to 100000, got '0'"),
        ("--nodes 5 --agents 2 --seed -1 a.json", "--seed: must be a whole number of at least 0"),
        (
            "--nodes 5 --agents 2 --distribution ring a.json",
            "unknown distribution 'ring'; choose from",
        ),
        ("--nodes 5 --agents 2 a.tsp", "a.tsp: unknown suffix '.tsp'; choose from ['.json']"),
        ("--nodes 5 --agents 2 nowhere/a.json", "nowhere/a.json: cannot write it (No such file or directory)"),
        ("--agents 2 a.json", "Missing from mtsp generate: --nodes N"),
    ],
)
def test_generate_refuses(folder, capsys, argv: str, message: str) -> None:
    assert message in refused(capsys, "generate", *argv.split())
    assert not Path("a.json").exists()


# The command itself


def test_version_and_help(capsys) -> None:
    for argv in (["--version"], ["--help"], ["solve", "--help"], ["generate", "--help"]):
        with pytest.raises(SystemExit) as caught:
            main(argv)
        assert caught.value.code == 0
        out = capsys.readouterr().out
        assert out == f"mtsp {__version__}\n" if argv == ["--version"] else "example" in out


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_bad_option_is_one_line_in_any_language(capsys, monkeypatch, encoding: str) -> None:
    """tyro draws its boxes with the letters that can be printed."""
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding))
    assert refused(capsys, "solve", "a.json", "--agents", "x") == (
        "mtsp: error: Error parsing --agents: must be a whole number from 1 to 100000, got 'x'\n"
    )
    print("± 1")
    sys.stdout.flush()
    assert sys.stdout.buffer.getvalue().decode(encoding) == ("± 1\n" if encoding == "utf-8" else "? 1\n")


def test_no_command_or_an_unknown_one(capsys) -> None:
    assert "Expected one of {solve, generate, serve}" in refused(capsys)
    assert "Unrecognized options: sovle" in refused(capsys, "sovle")

"""Reports agree with their rows: statistics by hand; every damaged line and every failure is named."""

import gzip
import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from made_up import one_agent_does_it_all, row

from benchmarks import best_known, suite
from benchmarks.__main__ import main
from benchmarks.harness import rows
from benchmarks.reports import plots, statistics
from benchmarks.reports.markdown import markdown_table
from benchmarks.reports.report import report
from benchmarks.reports.tables import BOUND
from benchmarks.solvers import SOLVERS
from mtsp_env import Instance, makespan

INSTANCES = suite.cells("smoke")[0].instances(7)
HALVES = [[0, 1, 2, 3, 0], [0, 4, 5, 6, 7, 0]]
ALL_BY_ONE = one_agent_does_it_all(INSTANCES[0])
SWAPPED = [[0, 2, 1, 3, 0], [0, 4, 5, 6, 7, 0]]
COSTS = {
    name: [makespan(i, tours) for i in INSTANCES]
    for name, tours in (("halves", HALVES), ("one", ALL_BY_ONE), ("swapped", SWAPPED))
}


@pytest.fixture(autouse=True)
def no_kept_tours(tmp_path_factory, monkeypatch):
    """Only the tours of the rows are known."""
    monkeypatch.setattr(statistics.load, "__defaults__", (None, tmp_path_factory.mktemp("best")))


def measured(method, tours, **more):
    return [row(instance, tours, k, method=method, **more) for k, instance in enumerate(INSTANCES)]


def failed(like, status, error, **more):
    return replace(like, status=status, error=error, tours=None, makespan=None, **more)


def write(path, results):
    text = "".join(json.dumps(asdict(row)) + "\n" for row in results).encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return path


def line_of(text, heading, label):
    """The cells of a method's line in the table under a heading."""
    table = text.split(f"### {heading}", 1)[1].split("###")[0]
    (line,) = [line for line in table.splitlines() if line.startswith(f"| {label} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_mean_and_standard_error_by_hand():
    assert statistics.mean([1, 2, 3, 6]) == (3.0, pytest.approx(math.sqrt((4 + 1 + 0 + 9) / 3 / 4)), 4)
    assert statistics.mean([2.5]) == (2.5, None, 1)
    assert statistics.mean([]) is None


@pytest.mark.parametrize(
    ("differences", "expected"),
    [
        ([-1, -2, -3, -4, -5], (5, 0, 0, 2 / 2**5)),  # all signs alike: 2 of the 32 assignments of signs
        ([-1, -2, -3, -4, 5], (4, 0, 1, 20 / 2**5)),  # ranks against: 5; ten of the 32 have a sum of at most 5, twice
        ([-3, 0, 1e-12, 2], (1, 2, 1, 1.0)),  # ties are left out
        ([0.0, 0.0], (0, 2, 0, 1.0)),
    ],
)
def test_pairs_by_hand(differences, expected):
    comparison = statistics.compare(np.array(differences, dtype=float))
    assert (comparison.wins, comparison.ties, comparison.losses) == expected[:3]
    assert comparison.p == pytest.approx(expected[3])
    assert comparison.difference == pytest.approx(np.mean(differences))


def test_gaps_are_to_the_best_of_the_rows_and_the_kept_tours(tmp_path):
    files = [
        write(tmp_path / "a.jsonl", measured("one", ALL_BY_ONE)),
        write(tmp_path / "b.jsonl.gz", measured("h", HALVES)),
    ]
    (results,) = statistics.load(files)
    known = np.minimum(COSTS["one"], COSTS["halves"])
    assert list(results.gaps("one", "8x2").values()) == pytest.approx(np.array(COSTS["one"]) / known - 1)
    (alone,) = statistics.load(files[:1])
    assert list(alone.gaps("one", "8x2").values()) == [0, 0, 0]

    folder = tmp_path / "kept"
    best_known.merge(suite.cells("smoke")[0], 7, {1: HALVES}, folder)
    (results,) = statistics.load(files[:1], None, folder)
    assert list(results.gaps("one", "8x2").values()) == pytest.approx([0, COSTS["one"][1] / COSTS["halves"][1] - 1, 0])
    assert (results.unkept, alone.unkept) == (2, 3)


def test_a_report_by_hand(tmp_path):
    slow = [replace(r, seconds=4.0 + k) for k, r in enumerate(measured("dan-s64", ALL_BY_ONE))]
    quick = measured("reference", HALVES, budget=0.5, bound=1.0)
    text = report([write(tmp_path / "rows.jsonl", [*slow, *quick])])
    costs, known = np.array([COSTS["one"], COSTS["halves"]]), np.minimum(COSTS["one"], COSTS["halves"])
    gaps = 100 * (costs / known - 1)
    for label, cost, gap, seconds in zip(["dan-s64", "reference 0.5 s"], costs, gaps, ["5", "1"], strict=True):
        mean, error = cost.mean(), cost.std(ddof=1) / math.sqrt(3)
        assert line_of(text, "Makespan", label) == [f"{mean:.3f} ± {error:.3f}"]
        mean, error = gap.mean(), gap.std(ddof=1) / math.sqrt(3)
        assert line_of(text, "Gap", label) == [f"{mean:.2f} ± {error:.2f}", f"{mean:.2f} ± {error:.2f} (3)"]
        assert line_of(text, "Seconds", label) == [seconds]
    wins = int((costs[1] < costs[0]).sum())
    assert wins == 3  # so p is 2 of 8
    assert line_of(text, "Against dan-s64", "reference 0.5 s") == ["3/0/0, p = 0.25"] * 2 + ["1 of 1 cells"]
    assert "**dan-s64 loses to** reference 0.5 s; it beats none." in text
    bound_gaps = 100 * (1 - 1 / costs[1])
    assert line_of(text, "Proved", "reference 0.5 s")[0].startswith(f"0 of 3, {bound_gaps.mean():.2f} ± ")
    assert "8, 2 (3)" in text and "6 rows, test set seed 7" in text
    assert "Against" not in report([tmp_path / "rows.jsonl"], against="lkh3")


def test_every_table_has_the_trip_to_the_farthest_city_as_a_bound(tmp_path):
    slow, quick = measured("dan-s64", ALL_BY_ONE), measured("reference", HALVES, budget=0.5)
    text = report([write(tmp_path / "rows.jsonl", [*slow, *quick])])
    bounds = np.array([2 * max(math.dist(i.nodes[0], city) for city in i.nodes[1:]) for i in INSTANCES])
    mean, error = bounds.mean(), bounds.std(ddof=1) / math.sqrt(3)
    assert line_of(text, "Makespan", BOUND) == [f"{mean:.3f} ± {error:.3f}"]
    gaps = 100 * (bounds / np.minimum(COSTS["one"], COSTS["halves"]) - 1)
    assert (gaps < 0).all()
    mean, error = gaps.mean(), gaps.std(ddof=1) / math.sqrt(3)
    assert line_of(text, "Gap", BOUND) == [f"{mean:.2f} ± {error:.2f}", f"{mean:.2f} ± {error:.2f} (3)"]


@pytest.mark.slow
def test_the_public_test_set_is_compared_with_published_numbers_of_the_same_instances(tmp_path, monkeypatch):
    """The published gap is that of the means over all 100 instances, however few of them have rows."""
    cell = suite.find_cell("seed3333", "100x5")
    tours = one_agent_does_it_all(cell.instances(3333)[0])
    kept = tmp_path / "kept"
    result = row(cell.instances(3333)[0], tours, 0, "100x5", "seed3333", method="joint-greedy", seed=3333)
    path = write(tmp_path / "rows.jsonl", [result])
    monkeypatch.setattr(statistics.load, "__defaults__", (None, kept))
    text = report([path])
    assert line_of(text, "Makespan", "*DPN, published*") == ["2.2693"]
    assert "*DPN, published*" not in text.split("### Gap")[1].split("###")[0]  # no best known tours yet
    best_known.merge(cell, 3333, dict.fromkeys(range(100), tours), kept)
    mean = np.mean([makespan(i, tours) for i in cell.instances(3333)])
    assert line_of(report([path]), "Gap", "*DPN, published*") == [f"{100 * (2.2693 / mean - 1):.2f}", ""]
    report([path], out=tmp_path / "report")
    assert (tmp_path / "report" / "gaps-seed3333.png").read_bytes().startswith(b"\x89PNG")


def test_the_bound_of_rounded_legs_takes_the_shortest_path():
    """The depot, a city at a distance of 2.8 (rounded: 3) and one half-way, at 1.4 from both (rounded: 1 and 1)."""
    instance = Instance([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]], 1, scale=2.8)
    assert suite.rounded_bound(instance) == 2 * (1 + 1) < suite.rounded_length(instance, [[0, 1, 0]]) == 6
    assert suite.rounded_bound(instance) == suite.rounded_length(instance, [[0, 2, 1, 2, 0]])
    assert statistics.bound(instance) == (2.0, 5.6, 4)


def test_failures_are_counted_in_notes(tmp_path):
    good, bad = measured("reference", HALVES, budget=1.0), measured("lkh3", HALVES, budget=1.0)
    late = failed(bad[0], "timeout", "killed 10 s after its limit of 1 s")
    gone = [failed(r, "crash", "killed by\n SIGSEGV | core") for r in measured("exact", HALVES, budget=1.0)]
    text = report([write(tmp_path / "rows.jsonl", [*good, late, bad[1], *gone])])
    assert line_of(text, "Makespan", "exact 1 s") == ["-<sup>2</sup>"]
    assert line_of(text, "Makespan", "lkh3 1 s") == [f"{COSTS['halves'][1]:.3f}<sup>1</sup>"]
    assert line_of(text, "Gap", "exact 1 s") == ["-<sup>2</sup>", "- (0)"]
    assert "\n1. of 3: 1 × timeout: killed 10 s after its limit of 1 s; 1 not run\n" in text
    assert "\n2. of 3: 3 × crash: killed by SIGSEGV / core\n" in text


def test_a_busy_machine_is_mentioned(tmp_path):
    rows = measured("reference", HALVES, budget=1.0)  # a second of wall time each
    alone = [replace(r, cpu_seconds=0.95) for r in rows]
    assert "of a core" not in report([write(tmp_path / "alone.jsonl", alone)])
    assert "of a core" not in report([write(tmp_path / "short.jsonl", [replace(r, seconds=0.1) for r in alone])])
    shared = [replace(alone[0], cpu_seconds=0.5), *alone[1:]]
    assert "- 1 of 3 solves had less than 90% of a core" in report([write(tmp_path / "shared.jsonl", shared)])


def test_the_later_row_counts(tmp_path):
    first = [failed(r, "error", "no") for r in measured("nearest", HALVES)]
    (results,) = statistics.load([write(tmp_path / "rows.jsonl", first + measured("nearest", ALL_BY_ONE))])
    assert [r.makespan for r in results.solved("nearest", "8x2").values()] == COSTS["one"]


@pytest.mark.parametrize("name", ["rows.jsonl", "rows.jsonl.gz"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda line: line[:50], "not JSON"),
        (lambda line: b"", "not JSON"),
        (lambda line: b"\xff\xfe", "not JSON"),
        (lambda line: b"[1]", "expected an object with the fields"),
        (lambda line: line.replace(b'"seconds": 1.0', b'"minutes": 1.0'), "expected an object with the fields"),
        (lambda line: line.replace(b'"ok"', b'"fine"'), "Invalid enum value 'fine' - at `$.status`"),
        (lambda line: line.replace(b'"seconds": 1.0', b'"seconds": null'), "seconds"),
        (lambda line: line.replace(b"[0, 4, 5", b"[0, 5"), "city 4 missing"),
        (lambda line: line.replace(b'"makespan": ', b'"makespan": 1'), "that of its tours"),
        (lambda line: line.replace(b'"8x2"', b'"9x2"'), "no cell '9x2'"),
    ],
)
def test_a_damaged_line_is_named(tmp_path, name, damage, message, capsys):
    lines = [json.dumps(asdict(r)).encode() for r in measured("nearest", HALVES)]
    lines[1] = damage(lines[1])
    text = b"\n".join(lines) + b"\n"
    path = tmp_path / name
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    assert main(["report", str(path)]) == 2
    stderr = capsys.readouterr().err
    assert f"{path}:2: " in stderr and message in stderr


def test_other_damage_is_named_too(tmp_path, capsys):
    path = write(tmp_path / "rows.jsonl.gz", measured("nearest", HALVES))
    path.write_bytes(path.read_bytes()[:-20])
    assert main(["report", str(path)]) == 2
    assert f"{path}: not a whole gzip file" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "none.jsonl")]) == 2
    assert main(["report"]) == 2
    assert "name at least one file" in capsys.readouterr().err


def test_two_networks_under_one_name_are_refused(tmp_path):
    old = write(tmp_path / "old.jsonl", measured("dan-s64", HALVES, versions={"weights": "aaa"}))
    new = write(tmp_path / "new.jsonl", measured("dan-s64", HALVES, versions={"weights": "bbb"}))
    with pytest.raises(ValueError, match=r"new\.jsonl:1: rows of dan-s64 with weights bbb, in .*old\.jsonl with aaa"):
        statistics.load([old, new])


def test_published_numbers_stand_beside_measured_ones(tmp_path):
    results = []
    for label in ("50x5", "50x10"):
        cell = replace(suite.find_cell("1", label), count=1)
        tours = one_agent_does_it_all(cell.instances(7)[0])
        for method in ("dan-s64", "ortools", "lkh3"):
            results.append(row(cell.instances(7)[0], tours, 0, label, "1", method=method))
    text = report([write(tmp_path / "rows.jsonl", results)])
    assert line_of(text, "Makespan", "*OR-Tools, published*") == ["2.04", "1.96"]
    assert line_of(text, "Seconds", "*OR-Tools, published*") == ["12", "12"]
    assert line_of(text, "Makespan", "*LKH3, Kim et al. 2022*") == ["2.00", "1.91"]
    names = [
        line.split("|")[1].strip() for line in text.split("### Makespan")[1].split("###")[0].splitlines() if "|" in line
    ]
    order = ["*DAN s.64, published*", "dan-s64", "*OR-Tools, published*", "ortools", "*LKH3, Kim et al. 2022*", "lkh3"]
    assert names[-7:] == [*order, BOUND]
    assert "*EA, published*" in names[2:-7]


def test_table_3_has_both_lengths_and_names_the_mix_up(tmp_path):
    folder = tmp_path / "tsplib"
    folder.mkdir()
    xy = np.random.default_rng(0).integers(0, 700, (150, 2))
    head = "NAME: gtsp150\nTYPE: TSP\nDIMENSION: 150\nEDGE_WEIGHT_TYPE: EUC_2D\nNODE_COORD_SECTION\n"
    (folder / "gtsp150.tsp").write_text(head + "".join(f"{i} {x} {y}\n" for i, (x, y) in enumerate(xy, 1)) + "EOF\n")
    (cell,) = [cell for cell in suite.cells("3", folder) if cell.n_agents == 10]
    instance = cell.instances(7)[0]
    tours = one_agent_does_it_all(instance)
    result = row(instance, tours, 0, cell.label, "3", method="dan-s256")
    result = replace(
        result, length=result.makespan * instance.scale, rounded_length=suite.rounded_length(instance, tours)
    )
    path = write(tmp_path / "rows.jsonl", [result])
    text = report([path])
    assert line_of(text, "Longest tour, every leg", "*DAN s.256, published*") == ["1610"]
    assert line_of(text, "Longest tour, every leg", "dan-s256") == [str(result.rounded_length)]
    assert line_of(text, "Longest tour, not rounded", "dan-s256") == [f"{result.length:.1f}"]
    assert line_of(text, "Longest tour, not rounded", BOUND) == ["-"]  # the file was not given
    farthest = np.linalg.norm(xy - xy[0], axis=1).max()
    text_with_file = report([path], tsplib=folder)
    assert line_of(text_with_file, "Longest tour, every leg", BOUND) == [str(suite.rounded_bound(instance))]
    assert line_of(text_with_file, "Longest tour, not rounded", BOUND) == [f"{2 * farthest:.1f}"]
    assert "gtsp150, 10 (1)" in text and "under the name kroa150" in text and "For 1 of 1 instances the best" in text
    write(path, [replace(result, makespan=0.5)])
    report([path])  # without the files nothing is checked
    with pytest.raises(ValueError, match=r"rows\.jsonl:1: its makespan is 0\.5"):
        report([path], tsplib=folder)


@pytest.mark.slow
def test_a_folder_gets_the_tables_and_the_pictures(tmp_path, capsys):
    results = measured("dan-s64", HALVES) + measured("reference", SWAPPED, budget=1.0) + measured("misc:own", HALVES)
    results += [replace(r, budget=10.0) for r in results if r.budget]
    cell = replace(suite.find_cell("figure4", "20x5"), count=1)
    tours = one_agent_does_it_all(cell.instances(7)[0])
    results += [row(cell.instances(7)[0], tours, 0, "20x5", "figure4", method="dan-greedy")]
    results += [failed(replace(results[-1], method="ortools-first"), "timeout", "killed", seconds=610.0)]
    out = tmp_path / "results"
    assert main(["report", str(write(tmp_path / "rows.jsonl", results)), "--out", str(out)]) == 0
    names = ["report.md", "planning-time-figure4.png", "gaps-smoke.png"]
    assert capsys.readouterr().out.split() == [str(out / name) for name in names]
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    for name in names[1:]:
        assert (out / name).read_bytes().startswith(b"\x89PNG")
        assert f"]({name})" in (out / "report.md").read_text(encoding="utf-8")


def test_every_solver_has_a_style_of_its_own():
    assert set(plots.STYLE) == set(SOLVERS)
    assert len(set(plots.STYLE.values())) == len(SOLVERS)


def test_rows_come_back_as_they_were_written():
    written = measured("nearest", HALVES, versions={"weights": "abc"}, machine={"cores": 2})[0]
    assert rows.parse(json.dumps(asdict(written))) == written


def test_a_markdown_table_has_a_cell_for_each_head():
    assert markdown_table(["a", "b"], [["x", 1], ["y", 2.5]]) == "| a | b |\n|---|---|\n| x | 1 |\n| y | 2.5 |"
    with pytest.raises(ValueError, match="expected 2 cells in a line, got 1"):
        markdown_table(["a", "b"], [["x"]])


def test_a_new_table_needs_no_title(tmp_path, monkeypatch):
    monkeypatch.setitem(suite.TABLES, "mine", suite.TABLES["smoke"])
    text = report((write(tmp_path / "rows.jsonl", measured("deals", HALVES, table="mine")),))
    assert "## Table mine\n" in text

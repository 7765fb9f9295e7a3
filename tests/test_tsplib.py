"""TSPLIB files: lengths by hand for each type, errors that name a damaged file, the instances of the paper."""

import itertools
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mtsp_env import Instance, lower_bound, read_tsplib
from mtsp_env.tsplib import EARTH_RADIUS, degrees, project

pytest.importorskip("vrplib", reason="needs the extra tsplib")

ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared" / "data" / "tsplib"


@pytest.fixture
def read(tmp_path):
    """A function that writes a file and reads it: read(kind, rows) for a valid file, read(text=...) for any text."""

    def write_and_read(kind: str = "EUC_2D", rows: list | None = None, text: str | bytes | None = None) -> Instance:
        if text is None:
            rows = [(0, 0), (3, 4)] if rows is None else rows
            text = "\n".join(
                [
                    "NAME : example",
                    "TYPE : TSP",
                    "COMMENT : two: colons",
                    f"DIMENSION : {len(rows)}",
                    f"EDGE_WEIGHT_TYPE : {kind}",
                    "NODE_COORD_SECTION",
                    *(" ".join(map(str, (number, *row))) for number, row in enumerate(rows, 1)),
                    "EOF",
                ]
            )
        path = tmp_path / "example.tsp"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_tsplib(path, 2)

    return write_and_read


def lengths(instance: Instance) -> np.ndarray:
    """All distances (n, n) in the file's units."""
    return np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=2) * instance.scale


def great_circle(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Kilometres between two points given in degrees: TSPLIB 95's formula without its rounding."""
    (lat, lon), (lat2, lon2) = (map(math.radians, point) for point in (one, other))
    q1, q2, q3 = math.cos(lon - lon2), math.cos(lat - lat2), math.cos(lat + lat2)
    return EARTH_RADIUS * math.acos(max(-1.0, min(1.0, 0.5 * ((1 + q1) * q2 - (1 - q1) * q3))))


# Lengths


@pytest.mark.parametrize("kind", ["EUC_2D", "CEIL_2D"])
def test_plane_by_hand(read, kind: str) -> None:
    instance = read(kind, [(10, 20), (13, 24), (10.5, -20)])
    assert (instance.name, instance.n_nodes, instance.n_agents, instance.scale) == ("example", 3, 2, 44.0)
    assert lengths(instance)[0] == pytest.approx([0, 5, math.hypot(0.5, 40)])  # not rounded: 40.003


def test_att_by_hand(read) -> None:
    """sqrt((dx^2 + dy^2) / 10), which TSPLIB would then round up."""
    assert lengths(read("ATT", [(0, 0), (30, 10), (0, 100)]))[0] == pytest.approx([0, 10, math.sqrt(1000)])


def test_geo_minutes_are_not_decimals() -> None:
    assert degrees(np.array([50.30, -0.08, -3.42, 180.0, 12.05, 45.80])).tolist() == pytest.approx(
        [50.5, -8 / 60, -3.7, 180.0, 12 + 5 / 60, 45 + 80 / 60]
    )


def test_geo_by_hand(read) -> None:
    """A quarter of a degree is 27.8 km along a meridian, and cos(60) of that along the 60th parallel."""
    degree = EARTH_RADIUS * math.pi / 180
    instance = read("GEO", [(60.00, 10.00), (60.15, 10.00), (60.00, 10.15)])
    assert lengths(instance)[0] == pytest.approx([0, degree / 4, degree / 8], rel=1e-5)
    east, north = instance.nodes[2] - instance.nodes[0], instance.nodes[1] - instance.nodes[0]
    assert east[0] > 10 * abs(east[1])  # as on a map
    assert north[1] > 10 * abs(north[0])


def test_geo_across_the_date_line_and_over_the_pole(read) -> None:
    degree = EARTH_RADIUS * math.pi / 180
    assert lengths(read("GEO", [(0.0, 179.0), (0.0, -179.0)]))[0, 1] == pytest.approx(2 * degree)
    assert lengths(read("GEO", [(89.0, 0.0), (89.0, 180.0)]))[0, 1] == pytest.approx(2 * degree)


places = st.tuples(st.floats(-90, 90), st.floats(-180, 180))


@pytest.mark.slow
@given(st.lists(places, min_size=2, max_size=6))
def test_projected_lengths_are_within_the_bound(points: list) -> None:
    """Never shorter than the great circle, longer by at most r / sin(r) for nodes within r of the centroid."""
    latitude, longitude = np.radians(points).T
    sphere = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    centre = sphere.mean(axis=1)
    assume(np.linalg.norm(centre) > 0.01)
    radius = math.acos(np.clip(centre @ sphere / np.linalg.norm(centre), -1, 1).min())

    plane = project(np.array(points))
    assert np.linalg.norm(plane, axis=1).max() == pytest.approx(EARTH_RADIUS * radius, abs=0.5)
    for i, j in itertools.combinations(range(len(points)), 2):
        flat, true = math.dist(plane[i], plane[j]), great_circle(points[i], points[j])
        assert flat >= true - 0.5  # km, the precision of acos for close points
        assert radius > math.pi / 2 or flat <= true * (radius / math.sin(radius) if radius else 1) + 0.5


def test_europe_is_as_precise_as_documented() -> None:
    instance = read_tsplib(ROOT / "examples" / "europe.tsp", 4)
    assert (instance.name, instance.n_nodes, instance.n_agents) == ("europe", 52, 4)
    rows = [line.split() for line in (ROOT / "examples" / "europe.tsp").read_text().splitlines() if line[0].isdigit()]
    places = degrees(np.array(rows, dtype=float)[:, 1:])
    pairs = list(itertools.combinations(range(52), 2))
    true = np.array([great_circle(places[i], places[j]) for i, j in pairs])
    error = np.array([lengths(instance)[i, j] for i, j in pairs]) / true - 1
    assert error.min() > -1e-9
    assert error.max() < 0.015
    assert error.mean() == pytest.approx(0.0011, abs=0.0001)
    prague_vienna, prague_lisbon = lengths(instance)[0, [1, 7]]
    assert prague_vienna == pytest.approx(252, abs=3)  # km, from an atlas
    assert prague_lisbon == pytest.approx(2245, abs=10)


# Other fields of a file


def test_name_type_and_encoding(read, tmp_path) -> None:
    head, tail = "DIMENSION: 2\nEDGE_WEIGHT_TYPE: EUC_2D\n", "NODE_COORD_SECTION\n1 0 0\n2 3.0e0 4\n"
    assert read(text=head + tail).name == "example"  # from the file's name
    assert read(text="NAME: 123\n" + head + tail).name == "123"
    assert read(text="TYPE: TSP (M. Hofmeister)\n" + head + tail).n_nodes == 2
    assert read(text=("COMMENT: Grötschel\r\n" + head + tail).encode("latin-1")).scale == 4.0
    assert read(text=head + tail + "DEPOT_SECTION\n1\n-1\nEOF").n_nodes == 2


GOOD = "DIMENSION: 2\nEDGE_WEIGHT_TYPE: EUC_2D\nNODE_COORD_SECTION\n1 0 0\n2 3 4\nEOF\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no EDGE_WEIGHT_TYPE; allowed are EUC_2D, CEIL_2D, ATT, GEO"),
        ("Dear diary", "not a TSPLIB file with EDGE_WEIGHT_TYPE EUC_2D, CEIL_2D, ATT, GEO"),
        ('{"nodes": [[0, 0], [1, 1]]}', "allowed are EUC_2D"),
        (bytes(range(256)) * 50, "EUC_2D, CEIL_2D, ATT, GEO"),
        (b"\x00" * 1000, "EUC_2D, CEIL_2D, ATT, GEO"),
        (GOOD.replace("EUC_2D", "MAN_2D"), "EDGE_WEIGHT_TYPE 'MAN_2D'; allowed are EUC_2D, CEIL_2D, ATT, GEO"),
        (GOOD.replace("EUC_2D", "EUC_3D"), "EDGE_WEIGHT_TYPE 'EUC_3D'; allowed"),
        (GOOD.replace("EDGE_WEIGHT_TYPE: EUC_2D\n", ""), "no EDGE_WEIGHT_TYPE"),
        ("TYPE: CVRP\n" + GOOD, "TYPE 'CVRP'; allowed is TSP"),
        ("TYPE: ATSP\n" + GOOD, "TYPE 'ATSP'; allowed is TSP"),
        ("DIMENSION: 2\nEDGE_WEIGHT_TYPE: EUC_2D\nEOF\n", "no NODE_COORD_SECTION"),
        (
            "DIMENSION: 2\nEDGE_WEIGHT_TYPE: EXPLICIT\nEDGE_WEIGHT_FORMAT: FULL_MATRIX\n"
            "EDGE_WEIGHT_SECTION\n0 1\n1 0\nEOF\n",
            "EDGE_WEIGHT_TYPE 'EXPLICIT'; allowed are EUC_2D",
        ),
        (
            "DIMENSION: 3\nEDGE_WEIGHT_TYPE: EXPLICIT\nEDGE_WEIGHT_FORMAT: UPPER_ROW\n"
            "EDGE_WEIGHT_SECTION\n1 2\n3\nEOF\n",
            "with EDGE_WEIGHT_TYPE EUC_2D",
        ),
        (GOOD.replace("DIMENSION: 2", "DIMENSION: 3"), "DIMENSION must be the number of nodes, 2, got 3"),
        (GOOD.replace("DIMENSION: 2", "DIMENSION: two"), "DIMENSION must be the number of nodes, 2, got 'two'"),
        (GOOD.replace("DIMENSION: 2\n", ""), "DIMENSION must be the number of nodes, 2, got None"),
        (GOOD.replace("2 3 4\n", ""), "DIMENSION must be the number of nodes, 1, got 2"),
        (GOOD.replace("DIMENSION: 2", "DIMENSION: 1").replace("2 3 4\n", ""), "at least 2, got 1"),
        (GOOD.replace("1 0 0\n2 3 4\n", ""), "every row of NODE_COORD_SECTION must be"),
        (GOOD.replace("2 3 4", "2 3"), "every row of NODE_COORD_SECTION must be a node number and two coordinates"),
        (GOOD.replace("1 0 0", "0 0").replace("2 3 4", "3 4"), "every row of NODE_COORD_SECTION must be"),
        (GOOD.replace("1 0 0", "1 0 0 0").replace("2 3 4", "2 3 4 5"), "every row of NODE_COORD_SECTION must be"),
        (GOOD.replace("2 3 4", "2 three 4"), "every row of NODE_COORD_SECTION must be"),
        (GOOD.replace("2 3 4", f"2 3 {10**400}"), "example.tsp: "),
        (GOOD.replace("2 3 4", "2 nan 4"), r"coordinates must be finite, got \[nan, 4.0\] in row 2"),
        (GOOD.replace("2 3 4", "2 3 -inf"), r"coordinates must be finite, got \[3.0, -inf\] in row 2"),
        (GOOD.replace("EUC_2D", "GEO").replace("2 3 4", "2 91.0 4"), r"latitude in \[-90, 90\]"),
        (GOOD.replace("EUC_2D", "GEO").replace("2 3 4", "2 3 565"), r"longitude in \[-360, 360\]"),
        (GOOD.replace("EUC_2D", "GEO").replace("2 3 4", "2 0 180"), "no centroid"),
        (GOOD.replace("EOF", "FIXED_EDGES_SECTION\n1 2\n-1\nEOF"), "FIXED_EDGES_SECTION is not supported"),
        (GOOD.replace("EOF", "DEPOT_SECTION\n2\n-1\nEOF"), "DEPOT_SECTION must name node 1"),
    ],
)
def test_an_invalid_file_is_refused_and_named(read, text: str | bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read(text=text)
    assert "example.tsp: " in str(caught.value)


@given(junk=st.binary(max_size=200), where=st.integers(0, len(GOOD)), cut=st.integers(0, len(GOOD)))
def test_damaged_files_raise_no_other_error(tmp_path_factory, junk: bytes, where: int, cut: int) -> None:
    """A file with a part missing or junk inserted is either read or refused with a ValueError that names it."""
    path = tmp_path_factory.getbasetemp() / "junk.tsp"
    path.write_bytes(GOOD[:where].encode() + junk + GOOD[max(where, cut) :].encode())
    try:
        assert read_tsplib(path, 1).n_agents == 1
    except ValueError as error:
        assert "junk.tsp: " in str(error)


def test_a_missing_file_a_directory_and_no_agents_are_refused(tmp_path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        read_tsplib(tmp_path / "nowhere.tsp", 2)
    with pytest.raises(ValueError, match="a directory, not a file"):
        read_tsplib(tmp_path, 2)
    with pytest.raises(ValueError, match="n_agents must be a whole number of at least 1, got 0"):
        read_tsplib(ROOT / "examples" / "europe.tsp", 0)


def test_without_vrplib_the_message_says_what_to_install(monkeypatch) -> None:
    for module in ("vrplib", "vrplib.parse"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r'pip install "mtsp-env\[tsplib\]"'):
        read_tsplib(ROOT / "examples" / "europe.tsp", 2)


# The instances of the paper's Table 3

PUBLISHED = sorted(SHARED.glob("*.tsp"))


@pytest.mark.skipif(not PUBLISHED, reason="needs the TSPLIB files of the paper's Table 3")
@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.stem)
def test_published_file_keeps_its_lengths(path: Path) -> None:
    instance = read_tsplib(path, 3)
    lines = [line.split() for line in path.read_text().splitlines()]
    xy = np.array([line[1:] for line in lines if len(line) == 3 and line[0].isdigit()], dtype=float)
    assert instance.name == path.stem
    np.testing.assert_allclose(lengths(instance), np.linalg.norm(xy[:, None] - xy, axis=2), atol=1e-9)


@pytest.mark.skipif(not PUBLISHED, reason="needs the TSPLIB files of the paper's Table 3")
def test_gtsp150_has_the_bound_that_the_paper_prints() -> None:
    """With 20 agents the farthest city sets the makespan; Table 3 gives 1554.64 under the name "kroa150"."""
    instance = read_tsplib(SHARED / "gtsp150.tsp", 20)
    assert lower_bound(instance) * instance.scale == pytest.approx(1554.64, abs=0.01)

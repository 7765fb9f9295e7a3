"""Animations: their frames show the right moments, and files are complete or absent."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from mtsp_env import Instance
from mtsp_env.picture import COLOURS, Picture, new_figure
from mtsp_env.render import animate, check_animation_suffix
from mtsp_env.schedule import make_log, moment

pytest.importorskip("matplotlib", reason="needs the extra render")
Image = pytest.importorskip("PIL.Image", reason="needs the extra render")

SHORT = {"seconds": 0.5, "frames_per_second": 8}  # four frames


def frames_of(path) -> tuple[list[np.ndarray], list[int]]:
    """The frames of a GIF, uint8 (height, width, 3), and their durations in ms."""
    with Image.open(path) as image:
        frames, durations = [], []
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.array(image.convert("RGB")))
            durations.append(image.info["duration"])
    return frames, durations


def has_colour(frame: np.ndarray, colour: str) -> bool:
    """Whether a frame has the colour; GIFs have few colours, so a channel may be a little off."""
    rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return bool((np.abs(frame.astype(int) - rgb).max(axis=-1) <= 10).any())


@pytest.mark.slow
def test_a_gif_shows_the_team_from_the_depot_to_the_end(tmp_path, square, square_tours) -> None:
    animate(tmp_path / "a.gif", square, square_tours, **SHORT)
    frames, durations = frames_of(tmp_path / "a.gif")
    assert durations == [120, 120, 120, 2000]  # a GIF counts in hundredths of a second
    assert {frame.shape for frame in frames} == {(480, 640, 3)}
    assert all(not np.array_equal(*pair) for pair in itertools.pairwise(frames))
    assert frames[-1][0, 0].tolist() == [255, 255, 255]
    assert all(has_colour(frames[-1], colour) for colour in COLOURS[:2])
    assert not any(has_colour(frames[-1], colour) for colour in COLOURS[2:5])
    assert list(tmp_path.iterdir()) == [tmp_path / "a.gif"]


@pytest.mark.slow
def test_tours_and_their_log_look_the_same(tmp_path, square, square_tours) -> None:
    animate(tmp_path / "tours.gif", square, square_tours, **SHORT)
    animate(tmp_path / "log.gif", square, log=make_log(square, square_tours), **SHORT)
    assert (tmp_path / "tours.gif").read_bytes() == (tmp_path / "log.gif").read_bytes()


def test_a_moment_is_drawn_as_it_is(square: Instance, square_tours: list[list[int]]) -> None:
    ax = new_figure((8.0, 6.0)).subplots()
    picture, log = Picture(ax, square, longest=2000.0), make_log(square, square_tours)
    picture.update_moment(moment(square, log, 0.75), 0.75, 2.0)
    cities, discs = ax.collections
    assert discs.get_offsets().tolist() == [[0.25, 1.0], [0.75, 0.0]]
    assert [tuple(colour) for colour in discs.get_facecolors()] == [tuple(colour) for colour in picture.colours]
    assert ax.get_lines()[0].get_xydata().tolist() == [[0.5, 0.5], [0.5, 1.0], [0.25, 1.0]]
    assert int((cities.get_facecolors() == (1, 1, 1, 1)).all(axis=1).sum()) == 4  # unvisited
    assert ax.get_title() == "square: time 0.750, 2 of 6 cities"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "agent 0:  1",
        "agent 1:  1",
    ]  # none is longest
    picture.update_moment(moment(square, log, 2.0), 2.0, 2.0)
    assert ax.get_title() == "square: 6 cities, 2 agents, makespan 2"


@pytest.mark.slow
def test_nobody_goes_anywhere(tmp_path) -> None:
    animate(tmp_path / "a.gif", Instance([[0.5, 0.5]] * 3, 2), [[0, 1, 2, 0], [0, 0]], **SHORT)
    assert (tmp_path / "a.gif").stat().st_size > 0


@pytest.mark.slow
def test_an_mp4_has_all_frames_and_two_seconds_more(tmp_path, square, square_tours) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    animate(tmp_path / "a.MP4", square, square_tours, **SHORT)
    frames = ffmpeg.read_frames(str(tmp_path / "a.MP4"))
    facts = next(frames)
    assert (facts["size"], facts["fps"]) == ((640, 480), 8)
    shown = [np.frombuffer(frame, np.uint8).reshape(480, 640, 3).astype(int) for frame in frames]
    assert len(shown) == 4 + 2 * 8
    assert np.abs(shown[3] - shown[-1]).mean() < 1.0 < np.abs(shown[0] - shown[-1]).mean()
    assert list(tmp_path.iterdir()) == [tmp_path / "a.MP4"]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.png", {}, r"unknown animation suffix '\.png'; choose from \['\.gif', '\.mp4'\]"),
        ("a", {}, "unknown animation suffix ''"),
        ("a.gif", {"seconds": 0}, "seconds must be a finite number of seconds above 0, got 0"),
        ("a.gif", {"frames_per_second": 0}, "frames_per_second must be a whole number of at least 1, got 0"),
        ("a.gif", {"log": [[], []]}, "either tours or a log"),
    ],
)
def test_bad_arguments(tmp_path, square, square_tours, name: str, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        animate(tmp_path / name, square, square_tours, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_failed_write_leaves_the_old_file(tmp_path, square, square_tours, monkeypatch, suffix: str) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    calls = iter(range(100))

    def fail(self, *_) -> None:
        if next(calls) == 2:
            raise RuntimeError("no memory left")

    monkeypatch.setattr(Picture, "update_moment", fail)
    with pytest.raises(RuntimeError, match="no memory"):
        animate(path, square, square_tours, **SHORT)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("module", "name", "extra"), [("matplotlib", "a.gif", "render"), ("imageio_ffmpeg", "a.mp4", "video")]
)
def test_a_missing_package_is_named(monkeypatch, module: str, name: str, extra: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf'pip install "mtsp-env\[{extra}\]"'):
        check_animation_suffix(name)


def test_cities_are_hidden_until_they_appear_and_broken_agents_are_grey(square) -> None:
    world = Instance(square.nodes, 2, appears=[0, 0, 0, 0, 0, 3.0, 0], breaks=[np.inf, 1.0])
    log = [[(1, 0.0, 0.75, 0.75)], [(4, 0.0, 0.5, 0.5)]]
    picture = Picture(new_figure((4.0, 4.0)).add_axes((0.0, 0.0, 1.0, 1.0)), world)
    for time, hidden, is_grey in ((0.5, {5}, False), (2.0, {5}, True), (3.0, set(), True)):
        picture.update_moment(moment(world, make_log(world, log=log), time), time, end=4.0)
        alpha = picture.cities.get_facecolor()[:, 3]
        assert {city for city in range(1, 7) if alpha[city - 1] == 0.0} == hidden
        red, green, blue, _ = picture.heads.get_facecolor()[1]
        assert (red == green == blue) == is_grey
        assert picture.ax.get_title().endswith(f"of {6 - len(hidden)} known cities")

"""Pictures: what is drawn, picture files, and windows on a machine without a display."""

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest

from mtsp_env import Instance, mtsp_v0, uniform
from mtsp_env.render import COLOURS, Viewer, check_suffix, draw_tours, format_lengths, save_picture

pytest.importorskip("matplotlib", reason="needs the extra render")
from matplotlib import pyplot
from matplotlib.colors import to_rgba, to_rgba_array

pytestmark = pytest.mark.filterwarnings("error")


def legend(ax) -> list[str]:
    return [text.get_text() for text in ax.get_legend().get_texts()]


def drawn_line(ax, agent: int) -> list[list[float]]:
    return np.transpose(ax.get_lines()[agent].get_data()).tolist()


# What is drawn


def test_finished_tours(square: Instance, square_tours: list[list[int]]) -> None:
    ax = draw_tours(square, square_tours)
    for agent, tour in enumerate(square_tours):
        assert drawn_line(ax, agent) == square.nodes[tour].tolist()
        assert to_rgba(ax.get_lines()[agent].get_color()) == to_rgba(COLOURS[agent])
    depot = ax.get_lines()[-1]
    assert (depot.get_marker(), drawn_line(ax, -1)) == ("s", [[0.5, 0.5]])
    cities, heads = ax.collections
    assert cities.get_offsets().tolist() == square.nodes[1:].tolist()
    assert cities.get_facecolors().tolist() == to_rgba_array([COLOURS[0]] * 3 + [COLOURS[1]] * 3).tolist()
    assert len(heads.get_offsets()) == 0
    assert legend(ax) == ["agent 0:  2.000  longest", "agent 1:  2.000"]
    assert ax.get_title() == "square: 6 cities, 2 agents, makespan 2.000"
    assert ax.get_aspect() == 1.0


def test_tours_so_far(square: Instance) -> None:
    """An open tour has no return leg and a ring at its agent's destination; unvisited cities are hollow."""
    ax = draw_tours(square, [[0, 2, 1], [0]])
    assert drawn_line(ax, 0) == [[0.5, 0.5], [0.5, 1.0], [0.0, 1.0]]
    assert drawn_line(ax, 1) == [[0.5, 0.5]]
    cities, heads = ax.collections
    assert heads.get_offsets().tolist() == [[0.0, 1.0]]
    white, agent = to_rgba("white"), to_rgba(COLOURS[0])
    assert [tuple(face) for face in cities.get_facecolors()] == [agent, agent, white, white, white, white]
    assert not any(tuple(edge) == white for edge in cities.get_edgecolors()[2:])
    assert ax.get_title() == "square: 2 of 6 cities, longest tour so far 1.000"


def test_lengths_have_the_units_of_the_instance_and_the_longest_is_bold() -> None:
    instance = Instance([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]], 3, "road", scale=2000.0)
    ax = draw_tours(instance, [[0, 1, 0], [0, 2, 0], [0, 0]])
    assert legend(ax) == ["agent 0:  2,000", "agent 1:  4,000  longest", "agent 2:  0"]
    assert [text.get_fontweight() for text in ax.get_legend().get_texts()] == ["normal", "bold", "normal"]
    widths = [line.get_linewidth() for line in ax.get_lines()[:3]]
    assert widths[1] > widths[0] == widths[2]


def test_with_many_agents_the_longest_tours_are_listed() -> None:
    instance = Instance([[0.0, 0.0], *([k / 40, 0.0] for k in range(1, 41))], n_agents=40)
    ax = draw_tours(instance, [[0, k, 0] for k in range(1, 41)])
    assert ax.get_legend().get_title().get_text() == "the 24 longest of 40 tours"
    assert [text.split(":")[0] for text in legend(ax)] == [f"agent {k}" for k in range(16, 40)]
    for agent, handle in zip(range(16, 40), ax.get_legend().get_lines(), strict=True):
        assert to_rgba(handle.get_color()) == to_rgba(COLOURS[agent % 20])
        assert handle.get_linestyle() == ("-" if agent < 20 else "--")


def test_twenty_colours_differ_for_colour_blind_people_too() -> None:
    """CIE76 distances are above 15 (2 is noticeable) under normal vision, deuteranopia and protanopia.

    Source of the two matrices: Machado et al. 2009, severity 1.
    """
    deuteranopia = [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    protanopia = [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    srgb = to_rgba_array([*COLOURS, "white"])[:, :3]
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    for vision in (np.eye(3), deuteranopia, protanopia):
        xyz = np.clip(linear @ np.transpose(vision), 0, 1) @ to_xyz.T / to_xyz.sum(axis=1)
        f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
        lab = np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)
        assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)) > 15
    assert len(COLOURS) == 20


@pytest.mark.parametrize(
    ("lengths", "expected"),
    [
        ([2.0, 0.9], ["2.000", "0.900"]),
        ([5677.31, 999.6], ["5,677", "1,000"]),
        ([120.04, 3.0], ["120.0", "3.0"]),
        ([0.01234], ["0.01234"]),
        ([0.0, 0.0], ["0", "0"]),
        ([], []),
    ],
)
def test_lengths_are_formatted_alike(lengths: list[float], expected: list[str]) -> None:
    assert format_lengths(lengths) == expected


def test_names_and_titles_are_not_parsed_as_formulas(tmp_path) -> None:
    instance = Instance([[0.0, 0.0], [1.0, 1.0]], 1, name=r"$\broken{$ _x")
    save_picture(tmp_path / "a.svg", instance, [[0, 1, 0]])
    save_picture(tmp_path / "a.svg", instance, [[0, 1, 0]], title=r"$\frac$")


@pytest.mark.parametrize("nodes", [[[0.3, 0.3]] * 3, [[0.0, 0.5], [0.5, 0.5], [1.0, 0.5]]])
def test_degenerate_instances_can_be_drawn(tmp_path, nodes: list) -> None:
    save_picture(tmp_path / "a.png", Instance(nodes, 5), [[0, 1, 0], [0, 2, 0], [0, 0], [0, 0], [0]])


@pytest.mark.parametrize(
    ("tours", "message"),
    [
        ([[0, 1, 0]], "expected 2 tours, one per agent, got 1"),
        ([[0, 1, 0], [2, 0]], r"tour 1 must begin at the depot 0, got \[2, 0\]"),
        ([[0, 1, 0], []], r"tour 1 must begin at the depot 0, got \[\]"),
        ([[0, 7, 0], [0]], r"tour 0 visits node 7, outside 0\.\.6"),
        ([[0, -1, 0], [0]], r"tour 0 visits node -1, outside 0\.\.6"),
    ],
)
def test_invalid_tours_are_refused(square: Instance, tours: list, message: str) -> None:
    viewer = Viewer(show=False)
    for draw in (draw_tours, viewer.draw):
        with pytest.raises(ValueError, match=message):
            draw(square, tours)


# Files


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "magic"), [(".png", b"\x89PNG"), (".PNG", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")]
)
def test_the_suffix_decides_the_format(tmp_path, square, square_tours, suffix: str, magic: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    save_picture(path, square, square_tours)
    assert path.read_bytes().startswith(magic)
    assert list(tmp_path.iterdir()) == [path]


def test_a_given_title_replaces_the_default(tmp_path, square, square_tours) -> None:
    with pyplot.rc_context({"svg.fonttype": "none"}):
        save_picture(tmp_path / "a.svg", square, square_tours, title="my title")
    text = (tmp_path / "a.svg").read_text()
    assert "my title" in text
    assert "makespan" not in text


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.pgf", ".png"])
def test_an_unknown_suffix_is_refused(tmp_path, square, square_tours, name: str) -> None:
    with pytest.raises(ValueError, match=r"unknown picture suffix .*'png'"):
        save_picture(tmp_path / name, square, square_tours)
    assert list(tmp_path.iterdir()) == []
    assert check_suffix("some/where/a.JPG") == "jpg"


def test_a_failed_write_leaves_the_old_file(tmp_path, square, square_tours, monkeypatch) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        save_picture(path, square, square_tours)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="nowhere"):
        save_picture(tmp_path / "nowhere" / "a.png", square, square_tours)


# The viewer


def test_each_picture_is_an_array_of_its_own(square: Instance, square_tours: list[list[int]]) -> None:
    viewer = Viewer(show=False)
    start = viewer.draw(square, [[0], [0]])
    kept = start.copy()
    end = viewer.draw(square, square_tours)
    assert (start.shape, start.dtype) == ((600, 800, 3), np.uint8)
    assert np.array_equal(start, kept)
    assert not np.array_equal(start, end)
    assert np.array_equal(viewer.draw(square, [[0], [0]]), start)  # nothing of the picture before remains
    viewer.close()


@pytest.mark.slow
def test_a_reused_figure_shows_what_a_fresh_one_would(square: Instance, square_tours: list[list[int]]) -> None:
    other = uniform(np.random.default_rng(0), n_nodes=30, n_agents=4)
    tours = [[0, *part, 0] for part in np.array_split(np.arange(1, 30), 4)]
    used = Viewer(show=False)
    used.draw(other, tours)
    used.draw(square, [[0, 2], [0, 5]])
    for instance, shown in ((square, square_tours), (other, tours), (square, [[0, 1], [0]])):
        assert np.array_equal(used.draw(instance, shown), Viewer(show=False).draw(instance, shown))


@pytest.mark.slow
def test_the_colours_of_all_agents_are_visible(square: Instance, square_tours: list[list[int]]) -> None:
    pixels = {tuple(pixel) for pixel in Viewer(show=False).draw(square, square_tours).reshape(-1, 3).tolist()}
    for colour in (*COLOURS[:2], "black", "white"):
        assert tuple(round(255 * channel) for channel in to_rgba(colour)[:3]) in pixels
    assert not {tuple(round(255 * channel) for channel in to_rgba(colour)[:3]) for colour in COLOURS[2:]} & pixels


def test_a_window_never_blocks_and_close_removes_it(square, square_tours, monkeypatch) -> None:
    monkeypatch.setenv("DISPLAY", ":99")  # with a display, matplotlib would warn that Agg has no windows
    viewer, other = Viewer(show=True), Viewer(show=True)
    before = pyplot.get_fignums()
    for tours in ([[0], [0]], [[0, 2], [0]], square_tours):
        assert viewer.draw(square, tours) is None
    other.draw(square, square_tours)
    assert len(pyplot.get_fignums()) == len(before) + 2  # one window per viewer
    viewer.close()
    viewer.close()
    assert len(pyplot.get_fignums()) == len(before) + 1
    pyplot.close("all")  # as if the user had closed it
    other.draw(square, square_tours)
    assert len(pyplot.get_fignums()) == 1
    other.close()
    assert pyplot.get_fignums() == []


def test_without_a_window_pyplot_has_no_new_figures(tmp_path, square, square_tours) -> None:
    before = pyplot.get_fignums()
    draw_tours(square, square_tours)
    save_picture(tmp_path / "a.png", square, square_tours)
    Viewer(show=False).draw(square, square_tours)
    assert pyplot.get_fignums() == before


def test_draws_into_given_axes(square: Instance, square_tours: list[list[int]]) -> None:
    axes = pyplot.figure().subplots(1, 2)
    assert draw_tours(square, square_tours, axes[1]) is axes[1]
    assert not axes[0].has_data()
    pyplot.close("all")


# The environment's pictures, and a machine without matplotlib


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rgb_array", "human"])
def test_the_environment_renders_every_step(mode: str) -> None:
    env = mtsp_v0.env(n_nodes=6, n_agents=2, render_mode=mode)
    env.reset(seed=1)
    pictures = []
    for agent in env.agent_iter():
        observation, _, termination, truncation, _ = env.last()
        over = termination or truncation
        env.step(None if over else env.action_space(agent).sample(observation["action_mask"]))
        if not over:
            pictures.append(env.render())
    if mode == "human":
        assert pictures == [None] * len(pictures)
    else:
        assert all(picture.shape == (600, 800, 3) for picture in pictures)
        assert not np.array_equal(pictures[0], pictures[-1])
    env.close()
    assert pyplot.get_fignums() == []


@pytest.mark.slow
def test_matplotlib_is_imported_only_to_draw() -> None:
    code = "import sys, mtsp_env.render; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_without_matplotlib_the_message_says_what_to_install(monkeypatch, tmp_path, square, square_tours) -> None:
    for module in [name for name in sys.modules if name.split(".")[0] == "matplotlib"] + ["matplotlib"]:
        monkeypatch.setitem(sys.modules, module, None)
    for draw in (
        lambda: save_picture(tmp_path / "a.png", square, square_tours),
        lambda: draw_tours(square, square_tours),
        lambda: Viewer(show=False).draw(square, square_tours),
        lambda: Viewer(show=True).draw(square, square_tours),
    ):
        with pytest.raises(ImportError, match=r'pip install "mtsp-env\[render\]"'):
            draw()


# Worlds


def known_and_broken(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    return {"appears": np.zeros((batch, n_nodes)), "breaks": np.full((batch, n_agents), np.inf)}


@pytest.mark.slow
def test_the_environment_shows_who_waits_who_is_broken_and_which_cities_have_appeared() -> None:
    """By hand: agent 0 visits city 1 and waits at home; agent 1 visits city 2 and breaks down on its way to city 3."""
    nodes = [[0.5, 0.5], [0.6, 0.5], [0.3, 0.5], [0.1, 0.5], [0.5, 0.9]]
    instance = Instance(nodes, 2, appears=[0.0, 0.0, 0.0, 0.2, 1.5], breaks=[np.inf, 0.35])
    env = mtsp_v0.raw_env(5, 2, scenario=known_and_broken, depot="wait", render_mode="rgb_array")
    env.reset(options={"instance": instance})
    grey, hollow, shown, plan = to_rgba("#777777"), to_rgba("none"), {}, [1, 2, 0, 0, 3, 3, 0, 0, 4]
    while not any(env.terminations.values()):
        env.render()
        picture = env._viewer._picture
        notes = [text.split("  ")[2:] for text in legend(picture.ax)]
        title = picture.ax.get_title().removeprefix("mTSP: ").partition(",")[0]
        places, faces = picture.heads.get_offsets().tolist(), picture.heads.get_facecolor().tolist()
        discs = [(tuple(place), tuple(face)) for place, face in zip(places, faces, strict=True)]
        shown[env.now] = (title, notes, picture.cities.get_alpha().tolist(), discs)
        env.step(plan[int(env.game.decisions[0])])
    env.render()
    first, second, third = (0.6, 0.5), (0.3, 0.5), (0.1, 0.5)
    assert shown == {  # as the last agent to decide at each of these ticks sees it
        0: ("1 of 2 known cities", [["longest"], []], [1, 1, 0, 0], [(first, hollow)]),
        10: ("2 of 2 known cities", [[], ["longest"]], [1, 1, 0, 0], [(first, hollow), (second, hollow)]),
        20: ("2 of 3 known cities", [["waits"], ["longest"]], [1, 1, 1, 0], [(second, hollow)]),
        35: ("2 of 3 known cities", [[], ["broken"]], [1, 1, 1, 0], [(second, grey)]),
        75: ("3 of 3 known cities", [["longest"], ["broken"]], [1, 1, 1, 0], [(third, hollow), (second, grey)]),
        115: ("3 of 3 known cities", [["longest"], ["broken"]], [1, 1, 1, 0], [(second, grey)]),
        150: ("3 of 4 known cities", [["longest"], ["broken"]], [1, 1, 1, 1], [(second, grey)]),
    }
    assert picture.ax.get_title() == "mTSP: 4 cities, 2 agents, longest tour 1.800"
    assert legend(picture.ax) == ["agent 0:  1.800  longest", "agent 1:  0.200  broken"]

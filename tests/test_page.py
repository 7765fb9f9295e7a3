"""The page for the browser: it is one file that loads nothing, and in a real browser it shows the right moments."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from mtsp_env import Instance
from mtsp_env.render import COLOURS, make_page, save_page

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def data_of(page: str) -> dict[str, Any]:
    """The object that the page's script reads."""
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)[1])


class Elements(HTMLParser):
    """Collects the elements of a page: (tag, attributes)."""

    def __init__(self, page: str):
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list) -> None:
        self.found.append((tag, dict(attributes)))


# The file


def test_the_page_holds_the_tours_and_their_lengths(square: Instance, square_tours: list[list[int]]) -> None:
    data = data_of(make_page(square, square_tours, notes=["One.", "Two."]))
    assert data["heading"] == "square: 6 cities, 2 agents, makespan 2.000"
    assert data["nodes"] == square.nodes.tolist()
    assert [[drive[0] for drive in agent["drives"]] for agent in data["agents"]] == [tour[1:] for tour in square_tours]
    assert [agent["colour"] for agent in data["agents"]] == list(COLOURS[:2])
    row = {"cities": 3, "length": "2.000", "last": "100%"}
    assert all(row.items() <= agent.items() for agent in data["agents"])
    assert (data["end"], data["longest"], data["lastColumn"], data["decimals"]) == (2.0, 0, "share", 3)
    assert data["notes"] == ["One.", "Two."]


def test_a_log_says_when_everybody_is_home() -> None:
    instance = Instance([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]], 4, scale=1000.0, service=[0.0, 0.5, 0.0])
    log = [
        [(1, 0.0, 0.5, 1.0), (0, 1.0, 1.5, 1.5)],
        [(2, 0.0, 1.0, 1.0), (0, 1.0, math.inf, math.inf)],
        [(2, 0.0, 1.0, 1.0)],
        [],
    ]
    data = data_of(make_page(instance, log=log))
    assert [agent["last"] for agent in data["agents"]] == ["1,500", "–", "–", "0"]
    assert data["agents"][1]["drives"][1] == [0, 1.0, None, 0.0]
    assert data["heading"] == "mTSP: 2 cities, 4 agents, the end at 1,500"
    assert (data["lastColumn"], data["longest"]) == ("home at", -1)


def test_the_page_loads_nothing(square: Instance, square_tours: list[list[int]]) -> None:
    page = make_page(square, square_tours)
    elements = Elements(page).found
    assert not [attributes for _, attributes in elements if attributes.keys() & {"src", "href", "srcset", "action"}]
    assert not {tag for tag, _ in elements} & {"link", "img", "iframe", "object", "embed", "base"}
    assert re.findall(r"https?://[^\"\s]+", page) == ["http://www.w3.org/2000/svg"]  # a name, not an address
    policy = next(attributes["content"] for _, attributes in elements if "http-equiv" in attributes)
    assert policy.startswith("default-src 'none';")


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "<!--<script>", "{{data}}", 'a "b" & c', "é\u2028"]
)
def test_names_are_text(name: str) -> None:
    page = make_page(Instance([[0.0, 0.0], [1.0, 1.0]], 1, name=name), [[0, 1, 0]], notes=[name])
    assert data_of(page)["notes"] == [name]
    assert [tag for tag, _ in Elements(page).found].count("script") == 2


def test_files_are_written_whole(tmp_path, square, square_tours) -> None:
    save_page(tmp_path / "a.html", square, square_tours)
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == make_page(square, square_tours)
    with pytest.raises(ValueError, match="expected 2 tours"):
        save_page(tmp_path / "a.html", square, square_tours[:1])
    assert list(tmp_path.iterdir()) == [tmp_path / "a.html"]


# A world that changes, by hand: agent 0 visits city 1 and waits at home until agent 1, which has visited city 2, breaks
# down at 0.35 on its way to city 3; agent 0 visits that city, waits again, and visits city 4, which appears at 1.5.

CHANGING = Instance(
    [[0.5, 0.5], [0.6, 0.5], [0.3, 0.5], [0.1, 0.5], [0.5, 0.9]],
    2,
    appears=[0.0, 0.0, 0.0, 0.2, 1.5],
    breaks=[math.inf, 0.35],
)
CHANGING_LOG = [
    [(1, 0, 0.1, 0.1), (0, 0.1, 0.2, 0.2), (3, 0.35, 0.75, 0.75), (0, 0.75, 1.15, 1.15), (4, 1.5, 1.9, 1.9),
     (0, 1.9, 2.3, 2.3)],
    [(2, 0, 0.2, 0.2), (3, 0.2, math.inf, math.inf)],
]  # fmt: skip


def test_a_world_says_what_appears_and_who_breaks_down() -> None:
    data = data_of(make_page(CHANGING, log=CHANGING_LOG))
    assert (data["appears"], data["changes"]) == ([0.0, 0.0, 0.0, 0.2, 1.5], True)
    assert [agent["breaks"] for agent in data["agents"]] == [None, 0.35]
    assert [(agent["cities"], agent["length"]) for agent in data["agents"]] == [(3, "1.800"), (1, "0.350")]
    plain = data_of(make_page(Instance(CHANGING.nodes, 1), [[0, 1, 2, 3, 4, 0]]))
    assert (plain["appears"], plain["changes"], plain["agents"][0]["breaks"]) == (None, False, None)


# In a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        pytest.skip(f"needs one of {BROWSERS}")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def shown(browser: Any, tmp_path, square: Instance, square_tours: list[list[int]]) -> Iterator[Any]:
    """The square's page in the browser."""
    save_page(tmp_path / "a.html", square, square_tours)
    with opened(browser, tmp_path / "a.html") as page:
        yield page


@contextmanager
def opened(browser: Any, path: Path) -> Iterator[Any]:
    """A page in the browser; the test fails if the page writes to the console or asks for anything."""
    page, complaints = browser.new_page(), []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: complaints.append(request.url))
    page.goto(path.as_uri())
    yield page
    assert complaints == [path.as_uri()]
    page.close()


def state(page: Any) -> dict[str, Any]:
    """What the page shows: the clock, the discs' places, how many points each driven line has, the coloured cities."""
    return page.evaluate("""() => ({
        clock: document.getElementById("clock").textContent,
        discs: [...document.querySelectorAll(".tour circle")].map(({ cx, cy }) => [cx.baseVal.value, cy.baseVal.value]),
        driven: [...document.querySelectorAll(".driven")].map((line) => line.points.numberOfItems),
        coloured: [...document.querySelectorAll(".city")].filter((city) => city.style.fill !== "").length,
        chosen: [...document.querySelectorAll("tr.chosen")].map((row) => row.rowIndex - 1),
        faded: [...document.querySelectorAll(".tour")].map((tour) => getComputedStyle(tour).opacity !== "1"),
        detail: document.getElementById("detail").textContent,
        button: document.getElementById("play").textContent,
    })""")


def on_screen(page: Any, x: float, y: float) -> list[float]:
    """Where a point of the map is in the window."""
    return page.evaluate(
        """([x, y]) => {
            const point = new DOMPoint(x, y).matrixTransform(document.getElementById("map").getScreenCTM());
            return [point.x, point.y];
        }""",
        [x, y],
    )


@pytest.mark.slow
def test_the_slider_moves_the_team(shown: Any) -> None:
    end = state(shown)
    assert (end["clock"], end["driven"], end["coloured"]) == ("time 2.000", [5, 5], 6)
    assert end["discs"] == [[500, 500]] * 2  # home; the map is 1000 units wide with a margin of 30
    shown.fill("#time", "375")
    midway = state(shown)
    assert midway["clock"] == "time 0.750"
    assert midway["discs"] == [[265, 30], [735, 970]]  # halfway between cities 2 and 1, and between 4 and 5
    assert (midway["driven"], midway["coloured"]) == ([3, 3], 2)
    shown.fill("#time", "0")
    assert (state(shown)["coloured"], state(shown)["discs"]) == (0, [[500, 500]] * 2)


@pytest.mark.slow
def test_pointing_at_a_row_or_a_tour_singles_it_out(shown: Any) -> None:
    assert shown.inner_text("h1") == "square: 6 cities, 2 agents, makespan 2.000"
    assert shown.inner_text("#rows").split() == ["0", "3", "2.000", "100%", "1", "3", "2.000", "100%"]
    assert state(shown)["chosen"] == []
    shown.hover("#rows tr:nth-child(2)")
    pointed = state(shown)
    assert (pointed["chosen"], pointed["faded"], pointed["detail"]) == ([1], [True, False], "Agent 1: 0 4 5 6 0")
    shown.hover("h1")
    assert state(shown)["chosen"] == []
    shown.mouse.move(*on_screen(shown, 265, 265))  # inside the tour, not on it
    assert state(shown)["chosen"] == []
    shown.mouse.move(*on_screen(shown, 500, 265))  # on the leg from the depot to city 2
    assert state(shown)["chosen"] == [0]


@pytest.mark.slow
def test_play_runs_to_the_end(shown: Any) -> None:
    shown.clock.install()
    shown.fill("#time", "0")
    shown.click("#play")
    assert state(shown)["button"] == "Pause"
    shown.clock.run_for(6000)  # half of the twelve seconds
    assert 0.9 < float(state(shown)["clock"].removeprefix("time ")) < 1.1
    shown.clock.run_for(7000)
    assert (state(shown)["clock"], state(shown)["button"]) == ("time 2.000", "Play")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time", "states", "known", "coloured", "discs", "is_grey"),
    [
        (0.0, ["", ""], 2, 0, [[782, 782], [782, 782]], False),
        (0.25, ["waits", ""], 3, 2, [[782, 782], [312, 782]], False),  # agent 1 never arrives
        (0.4, ["", "broken"], 3, 2, [[688, 782], [124, 782]], True),
        (1.2, ["waits", "broken"], 3, 3, [[782, 782], [124, 782]], True),
        (2.3, ["", "broken"], 4, 4, [[782, 782], [124, 782]], True),
    ],
)
def test_worlds_change_with_the_slider(browser, tmp_path, time, states, known, coloured, discs, is_grey) -> None:
    save_page(tmp_path / "a.html", CHANGING, log=CHANGING_LOG)
    with opened(browser, tmp_path / "a.html") as page:
        page.evaluate("time => show(time)", time)
        now = state(page)
        assert [[round(x) for x in disc] for disc in now["discs"]] == discs
        assert now["coloured"] == coloured
        assert page.evaluate("cities.filter((city) => city !== null && city.style.display === '').length") == known
        assert page.evaluate("data.agents.map((_, index) => tours[index].cell.textContent)") == states
        assert page.evaluate("tours.map(({ disc }) => disc.style.fill !== '')") == [False, is_grey]
        drawn = page.evaluate("tours.map(({ planned, driven }) => planned.points.length - driven.points.length)")
        assert drawn == [0, 0]  # where they will go is not drawn
        assert page.is_visible("#state")


@pytest.mark.slow
def test_plain_pages_have_no_column_for_what_changes(shown: Any) -> None:
    assert not shown.is_visible("#state")
    assert shown.evaluate("tours.map(({ planned, driven }) => planned.points.length)") == [5, 5]

"""The examples of other libraries: their requirements are pinned, and those that can run here print makespans."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "examples" / "libraries"
HERE = ["cleanrl", "sb3", "torchrl"]  # whose requirements the tests have too
ROW = re.compile(r"^(\S+) +(\d+\.\d{3}) \+- \d+\.\d{3}$", re.MULTILINE)
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def scripts() -> set[str]:
    return {path.stem.removeprefix("with_") for path in FOLDER.glob("with_*.py")}


def makespans(library: str) -> dict[str, float]:
    """What an example prints after very few steps."""
    result = subprocess.run(
        [sys.executable, "-W", "ignore", str(FOLDER / f"with_{library}.py"), "--steps", "300"],
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"^\d+ steps, \d+ s of CPU time$", result.stdout, re.MULTILINE), result.stdout
    return {name: float(mean) for name, mean in ROW.findall(result.stdout)}


@pytest.mark.slow
@pytest.mark.parametrize("library", HERE)
def test_examples_print_makespans(library: str) -> None:
    printed = makespans(library)
    assert printed.keys() == {"random", "home-last", "nearest", "reference", library}
    assert printed["reference"] < printed["nearest"] < printed["home-last"] < printed["random"]
    assert printed["reference"] < printed[library]


def pins(text: str, python: str) -> list[Requirement]:
    """The requirements of a file that hold for a version of Python."""
    lines = [Requirement(line) for line in text.splitlines() if not line.startswith("#")]
    return [line for line in lines if line.marker is None or line.marker.evaluate({"python_version": python})]


def test_every_example_has_pinned_requirements() -> None:
    requirements = {path.stem: path.read_text(encoding="utf-8") for path in (FOLDER / "requirements").glob("*.txt")}
    assert requirements.keys() == scripts()
    for library, text in requirements.items():
        for python in PYTHONS:
            found = pins(text, python)
            names = [pin.name for pin in found]
            assert len(set(names)) == len(names), f"{library} on Python {python}: {names}"
            assert {"torch", "numpy", "gymnasium"} <= set(names), f"{library} on Python {python}: {names}"
            assert all(re.fullmatch(r"==[0-9][0-9A-Za-z.]*", str(pin.specifier)) for pin in found), library
        assert "torch==2.13.0" in text.splitlines(), library


@pytest.mark.parametrize("library", HERE)
def test_the_pins_of_the_examples_that_run_here_are_those_of_the_tests(library: str) -> None:
    """Otherwise the tests would run another version than the one that a reader installs."""
    tested = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    tested = {line.partition(";")[0].lower() for line in tested}
    text = (FOLDER / "requirements" / f"{library}.txt").read_text(encoding="utf-8")
    assert {f"{pin.name}{pin.specifier}".lower() for pin in pins(text, "3.11")} <= tested

"""Tests on other Pythons, each in an environment of its own.

nox                         env and dan
nox -s env                  the environment alone, without torch
nox -s dan-3.12             the environment and the networks on one Python
nox -s libraries            the examples of other libraries, one after the other: half an hour
nox -s "libraries(sb3)"     one of them
"""

from pathlib import Path

import nox

nox.options.default_venv_backend = "venv"
nox.options.reuse_venv = "yes"

PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
TOOLS = ["pytest", "hypothesis"]
ENV_TESTS = [
    "tests/test_instance.py",
    "tests/test_regret.py",
    "tests/test_render.py",
    "tests/test_schedule.py",
    "tests/test_self_check.py",
    "tests/test_single.py",
    "tests/test_tours.py",
    "tests/test_tsplib.py",
    "tests/test_wrappers.py",
]
DAN_TESTS = [
    *ENV_TESTS,
    "tests/test_actor.py",
    "tests/test_batched.py",
    "tests/test_cli.py",
    "tests/test_cli_process.py",
    "tests/test_dan.py",
    "tests/test_games.py",
    "tests/test_heuristics.py",
    "tests/test_kernels.py",
    "tests/test_mtsp_v0.py",
    "tests/test_planning.py",
    "tests/test_planning_policies.py",
    "tests/test_registry.py",
    "tests/test_rules.py",
    "tests/test_shipped.py",
]
EXAMPLES = "examples/libraries"
LIBRARIES = sorted(path.stem for path in Path(EXAMPLES, "requirements").glob("*.txt"))


@nox.session(python=PYTHONS)
def env(session: nox.Session) -> None:
    """Run the tests of mtsp_env that need no extra; tests that need one are skipped."""
    session.install("--constraint", "constraints.txt", "--editable", ".", *TOOLS)
    session.run("python", "-m", "pytest", *(session.posargs or ENV_TESTS))


@nox.session(python=PYTHONS)
def dan(session: nox.Session) -> None:
    """Run the tests of mtsp_env and dan_policy with everything that the wheel can use."""
    session.install("--constraint", "constraints.txt", "torch")
    session.install("--constraint", "constraints.txt", "--editable", ".[all]", *TOOLS)
    session.run("python", "-m", "pytest", *(session.posargs or DAN_TESTS))


@nox.session(python="3.11", default=False)
@nox.parametrize("library", LIBRARIES, ids=LIBRARIES)
def libraries(session: nox.Session, library: str) -> None:
    """Install a library beside this package and run its example: nox -s "libraries(sb3)" -- --steps 1000 --seed 1."""
    session.install("torch==2.13.0")  # first and alone, as in the Makefile
    session.install("--editable", ".[reference]", "--requirement", f"{EXAMPLES}/requirements/{library}.txt")
    session.run("python", f"{EXAMPLES}/with_{library}.py", *session.posargs, env={"OMP_NUM_THREADS": "1"})

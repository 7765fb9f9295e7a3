"""Tests on other Pythons, each in an environment of its own.

nox                  every session
nox -s env           the environment alone, without torch
nox -s dan-3.12      the environment and the networks on one Python
"""

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
    "tests/test_mtsp_v0.py",
    "tests/test_planning.py",
    "tests/test_registry.py",
    "tests/test_rules.py",
    "tests/test_shipped.py",
]


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

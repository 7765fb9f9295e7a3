"""Who may import whom: arrows point down only, and importing the environment stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("mtsp_env", "dan_policy", "train", "benchmarks")  # each may import those before it
FILES = sorted(file.relative_to(ROOT).as_posix() for package in PACKAGES for file in (ROOT / package).rglob("*.py"))

FACES = ["mtsp_env.mtsp_v0", "mtsp_env.batched", "mtsp_env.single", "mtsp_env.wrappers"]
EXTRAS = ["mtsp_env.reference", "mtsp_env.render"]

# What a file may not import, anywhere in it
FORBIDDEN = {
    "mtsp_env/instance.py": [
        *FACES,
        *EXTRAS,
        "mtsp_env.rules",
        "mtsp_env.tours",
        "mtsp_env.files",
        "mtsp_env.distributions",
    ],
    "mtsp_env/tours.py": [*FACES, *EXTRAS, "mtsp_env.rules"],
    "mtsp_env/rules.py": [*FACES, *EXTRAS, "gymnasium*", "pettingzoo*", "torch*"],
    "mtsp_env/state.py": [*FACES, *EXTRAS, "mtsp_env.rules", "mtsp_env.world", "torch*"],
    "mtsp_env/world.py": [*FACES, *EXTRAS, "mtsp_env.rules", "torch*"],
    "mtsp_env/mtsp_v0.py": ["mtsp_env.batched", "torch*"],
    "mtsp_env/batched.py": ["mtsp_env.mtsp_v0", *EXTRAS],
    "mtsp_env/reference/solver.py": [*FACES, "mtsp_env.render", "mtsp_env.rules"],
    "mtsp_env/render.py": [*FACES, "mtsp_env.reference"],
    "dan_policy/dan.py": ["mtsp_env*"],
    "dan_policy/joint.py": ["mtsp_env*"],
    "dan_policy/layers.py": ["mtsp_env*"],
    "dan_policy/network.py": ["mtsp_env*", "tensordict*", "torchrl*"],
    "dan_policy/actor.py": ["mtsp_env*"],
    "benchmarks/peers/rl4co_speed.py": ["mtsp_env*", "dan_policy*", "train*", "benchmarks*"],
}
NEEDS_AN_EXTRA = {"torch", "tensordict", "torchrl", "numba", "scipy", "matplotlib", "vrplib"}
LIGHT = [
    "__init__",
    "__main__",
    "arrays",
    "checks",
    "distributions",
    "files",
    "instance",
    "log",
    "machine",
    "mtsp_v0",
    "page",
    "picture",
    "rules",
    "schedule",
    "single",
    "spanning_tree",
    "state",
    "tours",
    "tsplib",
    "world",
    "wrappers",
]


def imports(file: Path, package: str) -> list[tuple[str, bool]]:
    """Every module that a file imports, with its full name, and whether the file's own import runs it."""
    imported: list[tuple[str, bool]] = []

    def visit(node: ast.AST, at_import: bool) -> None:
        if isinstance(node, ast.Import):
            imported.extend((alias.name, at_import) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            imported.append((module, at_import))
            imported.extend((f"{module}.{alias.name}", at_import) for alias in node.names)
        later = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        typing_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.iter_child_nodes(node):
            visit(child, at_import and not later and not typing_only)

    visit(ast.parse(file.read_text(encoding="utf-8")), True)
    return imported


def imports_of(file: str) -> list[tuple[str, bool]]:
    return imports(ROOT / file, file.rpartition("/")[0].replace("/", "."))


@pytest.mark.parametrize("file", FILES)
def test_arrows_point_down(file: str) -> None:
    above = PACKAGES[PACKAGES.index(file.partition("/")[0]) + 1 :]
    wrong = [name for name, _ in imports_of(file) if name.partition(".")[0] in (*above, "tests", "examples")]
    assert not wrong


@pytest.mark.parametrize("file", [file for file in FILES if file.startswith("train/")])
def test_training_starts_without_what_few_runs_need(file: str) -> None:
    """SciPy and TorchRL's collectors are slow to import."""
    slow = [name for name, at_import in imports_of(file) if at_import and fnmatch(name, "scipy*")]
    slow += [name for name, at_import in imports_of(file) if at_import and name == "train.remote"]
    assert not slow


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """The strongly connected components of more than one module."""
    order: list[str] = []
    seen: set[str] = set()

    def visit(module: str, edges: dict[str, set[str]], component: list[str]) -> None:
        seen.add(module)
        for other in sorted(edges[module]):
            if other not in seen:
                visit(other, edges, component)
        component.append(module)

    for module in graph:
        if module not in seen:
            visit(module, graph, order)
    reverse = {module: {other for other in graph if module in graph[other]} for module in graph}
    seen.clear()
    components = []
    for module in reversed(order):
        if module not in seen:
            components.append([])
            visit(module, reverse, components[-1])
    return [sorted(component) for component in components if len(component) > 1]


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_modules_do_not_import_each_other_in_circles(package: str) -> None:
    """Imports within functions and for type checkers also count."""
    names = {file: file.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for file in FILES}
    files = [file for file in FILES if file.partition("/")[0] == package and not file.endswith("__init__.py")]
    modules = {names[file] for file in files}
    graph = {names[file]: {name for name, _ in imports_of(file) if name in modules - {names[file]}} for file in files}
    assert not cycles(graph)


def test_cycles_are_recognised() -> None:
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]
    assert cycles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


@pytest.mark.parametrize("file", FORBIDDEN)
def test_files_import_nothing_forbidden(file: str) -> None:
    if not (ROOT / file).exists():
        pytest.skip("not written yet")
    names = {name for name, _ in imports_of(file)}
    assert not {name for name in names for pattern in FORBIDDEN[file] if fnmatch(name, pattern)}


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_import_no_extra_at_import(module: str) -> None:
    top_level = {name.partition(".")[0] for name, at_import in imports_of(f"mtsp_env/{module}.py") if at_import}
    assert not top_level & NEEDS_AN_EXTRA


@pytest.mark.slow
def test_the_environment_imports_light() -> None:
    """Importing it loads no heavy package, not even indirectly, and keeps NumPy's global random state."""
    code = f"""
import sys, numpy
numpy.random.seed(3)
before = numpy.random.get_state()[1].tobytes()
import mtsp_env, mtsp_env.mtsp_v0
assert numpy.random.get_state()[1].tobytes() == before, "numpy's global random state has changed"
heavy = sorted({NEEDS_AN_EXTRA!r} & set(sys.modules))
assert not heavy, heavy
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.slow
def test_planning_does_not_wait_for_torchrl() -> None:
    """TorchRL, TensorDict and torch's compiler together take twice as long to import as torch itself."""
    code = """
import sys
from dan_policy import solve
from mtsp_env import Instance
instance = Instance([[0.5, 0.5], [0.1, 0.2], [0.9, 0.3], [0.7, 0.8]], 2)
for policy in ("default", "dan"):
    solve(instance, policy, device="cpu", decode="sample", samples=2, augment=True, reconstruct=1)
late = sorted({"tensordict", "torchrl", "torch._dynamo"} & set(sys.modules))
assert not late, late
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("import torch.nn as nn", [("torch.nn", True)]),
        ("from mtsp_env import rules", [("mtsp_env", True), ("mtsp_env.rules", True)]),
        ("from . import rules", [("mtsp_env", True), ("mtsp_env.rules", True)]),
        ("from ..train.loss import f", [("train.loss", True), ("train.loss.f", True)]),
        ("try:\n import torch\nexcept ImportError: pass", [("torch", True)]),
        ("def f():\n import torch", [("torch", False)]),
        ("if TYPE_CHECKING:\n import torch", [("torch", False)]),
        ("class A:\n import torch", [("torch", True)]),
    ],
)
def test_imports_are_found(tmp_path: Path, code: str, expected: list[tuple[str, bool]]) -> None:
    """The check itself, on a file of the package ``mtsp_env``."""
    file = tmp_path / "module.py"
    file.write_text(code, encoding="utf-8")
    assert imports(file, "mtsp_env") == expected

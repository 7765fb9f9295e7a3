"""A network from a file outside the checkout is trained, validated, saved and used like the shipped ones.

The file is the one that docs/own-network.md tells its reader to save; the slow test runs the page's own commands.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from dan_policy import build, load, make_actor, save, solve
from dan_policy.registry import load_config
from mtsp_env import check_tours, read_tsplib
from train.__main__ import main
from train.validate import validate

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "own-network.md").read_text(encoding="utf-8")
PROGRAMS = {
    "python": [sys.executable],
    "mtsp": [sys.executable, "-c", "import sys; from dan_policy.cli import main; sys.exit(main())"],
}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The working directory: far from the checkout, with mynet.py and the cities of Europe in it."""
    (tmp_path / "mynet.py").write_text(re.search(r"```python file=mynet.py\n(.*?)```", PAGE, re.DOTALL)[1])
    (tmp_path / "europe.tsp").write_bytes((ROOT / "examples" / "europe.tsp").read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mynet", raising=False)
    return tmp_path


def run(line: str) -> str:
    """Run a command in the working directory with the checkout on the path; returns what it printed."""
    program, *arguments = shlex.split(line)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    done = subprocess.run([*PROGRAMS[program], *arguments], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def check_solves_europe(file: Path) -> None:
    """The file's network solves the instance, in a process of its own and in this one."""
    command = f"mtsp solve europe.tsp --agents 4 --policy {file} --network mynet:make"
    assert "makespan" in run(command)
    instance = read_tsplib("europe.tsp", 4)
    tours = solve(instance, load(file, network="mynet:make")).tours
    check_tours(instance, tours)


@pytest.mark.slow
def test_it_is_trained_validated_and_solves(folder, capsys):
    pytest.importorskip("numba", reason="the teacher is compiled with Numba")
    size = "--n-nodes 8 10 --n-agents 2 2 --nodes-per-agent 2"
    options = (
        f"--policy mynet:make --policy-options layers 1 embed_dim 16 {size} --steps 3 "
        "--set-tokens 100 --buffer 4 --workers 0 --teacher-iterations 5 --warmup 1 --average 0 --validate-every 3 "
        "--validation-instances 8 --out runs/mynet --no-tensorboard"
    )
    assert main(["imitate", *options.split()]) == 0
    file = Path("runs/mynet/best.safetensors")
    assert load_config(file) == {"layers": 1, "embed_dim": 16}
    capsys.readouterr()
    assert main(["validate", str(file), "--network", "mynet:make", *size.split(), "--instances", "8"]) == 0
    printed = capsys.readouterr().out
    (cost,) = validate((str(file),), "mynet:make", (8, 10), (2, 2), 2, 8)
    assert float(printed.split()[0]) == pytest.approx(cost, abs=1e-4)
    check_solves_europe(file)

    assert main(["average", str(file), str(file), "--network", "mynet:make", "--out", "mean.safetensors"]) == 0
    assert load_config("mean.safetensors") == load_config(file)
    mean, best = (load(one, network="mynet:make").state_dict() for one in ("mean.safetensors", file))
    assert all(torch.allclose(mean[name], weight, atol=1e-6) for name, weight in best.items())


def test_a_weights_file_does_not_decide_which_code_is_imported(folder):
    save("mynet.safetensors", build("mynet:make"), "mynet:make")
    with pytest.raises(ValueError, match="names the factory 'mynet:make'"):
        load("mynet.safetensors")


def test_it_sees_distances_and_angles_alone(folder):
    """A turned map gives other angles but the same distances; a network of distances alone would not notice."""
    polar = sys.modules[type(build("mynet:make")).__module__].polar
    points = torch.tensor([[1.0, 0.0], [0.0, 2.0], [-3.0, 0.0]])
    expected = torch.tensor([[1.0, 1.0, 0.0], [2.0, 0.0, 1.0], [3.0, -1.0, 0.0]])
    torch.testing.assert_close(polar(points), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(polar(points[:, [1, 0]])[:, [0, 2, 1]], expected, atol=1e-6, rtol=0)


def test_leading_dimensions_are_free_and_the_actor_reads_its_keys(folder):
    network = build("mynet:make", {"embed_dim": 16, "layers": 1}).eval()
    assert make_actor(network).in_keys[:4] == ["cities", "agents", "visited", "agent"]
    observation = (torch.rand(6, 9, 2), torch.rand(6, 3, 3), torch.zeros(6, 9, dtype=torch.bool), torch.arange(6) % 3)
    flat = network(*observation)
    deep = network(*(part.unflatten(0, (2, 3)) for part in observation))
    torch.testing.assert_close(deep.flatten(0, 1), flat)
    assert not torch.allclose(network(*observation[:3], (observation[3] + 1) % 3), flat)  # the deciding agent matters


@pytest.mark.slow
def test_the_commands_of_the_page_work(folder):
    """The page's own lines, but with some seconds instead of a minute of training, and fewer games."""
    shell = PAGE.split("## Train, validate and solve")[1].partition("```sh\n")[2].partition("```")[0]
    train, check, plan = shell.replace("\\\n", " ").splitlines()
    check += " --instances 32"
    assert "--seconds 60" in train
    run(train.replace("--seconds 60", "--seconds 8"))
    torch.manual_seed(0)  # the run's first weights
    save("initial.safetensors", build("mynet:make"), "mynet:make")
    trained, initial = (float(run(line).split()[0]) for line in (check, check.replace("runs/mynet/last", "initial")))
    assert trained < initial  # about 3.2 against 10.3; how many steps a minute has depends on the machine
    assert "makespan" in run(plan)

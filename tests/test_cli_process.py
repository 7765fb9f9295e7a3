"""The command ``mtsp`` with nothing faked: processes that lack packages, broken pipes, the real solver."""

import json
import os
import sys
from pathlib import Path

import pytest
from command import refused, run

import dan_policy
from dan_policy.cli import main
from mtsp_env import Instance, check_tours, lower_bound, makespan, read_tsplib

pytest.importorskip("rich", reason="needs the extra dan")
pytest.importorskip("vrplib", reason="needs the extra tsplib")

EUROPE = Path(__file__).parent.parent / "examples" / "europe.tsp"
TORCH = ("torch", "tensordict", "torchrl")


@pytest.mark.slow
def test_only_solving_imports_what_is_heavy(tmp_path) -> None:
    missing, file = (*TORCH, "matplotlib", "numba", "rich", "vrplib"), str(tmp_path / "a.json")
    made = run("generate", "--nodes", "5", "--agents", "2", file, missing=missing)
    assert (made.returncode, made.stderr) == (0, "")
    solved = run("solve", file, missing=missing)
    assert solved.returncode == 2
    assert solved.stderr.startswith("mtsp: error: ")
    assert solved.stderr.count("\n") == 1
    assert 'pip install "mtsp-env[dan]"' in solved.stderr


def test_without_tyro_the_command_names_the_extra() -> None:
    done = run("--help", missing=["tyro"])
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("mtsp: error: the command needs tyro")
    assert 'pip install "mtsp-env[dan]"' in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.slow
def test_help_needs_nothing_heavy() -> None:
    for argv in (["--help"], ["solve", "--help"], ["generate", "--help"]):
        done = run(*argv, missing=(*TORCH, "matplotlib", "numba", "rich", "vrplib", "scipy"))
        assert (done.returncode, done.stderr) == (0, "")
        assert "usage: mtsp" in done.stdout and "example" in done.stdout


@pytest.mark.slow
def test_the_reference_alone_needs_no_torch(folder, square: Instance) -> None:
    pytest.importorskip("numba", reason="needs the extra reference")
    argv = ("solve", "square.json", "--method", "reference", "--seed", "3")
    done = run(*argv, "--json", missing=(*TORCH, "rich"))
    assert (done.returncode, done.stderr) == (0, "")
    record = json.loads(done.stdout)
    check_tours(square, record["tours"])
    assert (record["makespan"], record["method"]) == (2.0, "reference")
    without_rich, without_numba = (run(*argv, missing=(*TORCH, name)) for name in ("rich", "numba"))
    assert (without_rich.returncode, without_numba.returncode) == (2, 2)
    assert without_rich.stderr.startswith("mtsp: error: the table needs rich")
    assert "pip install 'mtsp-env[reference]'" in without_numba.stderr
    assert without_rich.stderr.count("\n") == without_numba.stderr.count("\n") == 1
    assert without_rich.stdout == without_numba.stdout == ""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="pipes break differently there")
def test_a_reader_that_closes_the_pipe_is_no_error(tmp_path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    argv = ("generate", "--nodes", "5", "--agents", "2", str(tmp_path / "a.json"))
    done = run(*argv, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.slow
def test_solves_with_a_policy_from_a_file(folder, capsys) -> None:
    """Nothing is faked: an untrained network plans tours that the judge accepts."""
    pytest.importorskip("torchrl", reason="needs the extra dan")
    network = dan_policy.DAN(dan_policy.DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, city_layers=1))
    dan_policy.save("mine.safetensors", network)
    instance = read_tsplib(EUROPE, 3)
    for options in ("", "--decode sample --samples 4 --seed 1"):
        argv = ["solve", str(EUROPE), "--agents", "3", "--policy", "mine.safetensors", "--json", *options.split()]
        assert main(argv) == 0
        record = json.loads(capsys.readouterr().out)
        check_tours(instance, record["tours"])
        assert record["makespan"] == pytest.approx(makespan(instance, record["tours"]) * instance.scale)
        assert record["lower_bound"] == lower_bound(instance) * instance.scale <= record["makespan"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--policy nowhere.safetensors", "nowhere.safetensors"),
        ("--policy square.json", "square.json"),
        ("--policy mine.safetensors --device nonsense", "nonsense"),
        ("--policy mine.safetensors --device cuda:99", "cuda:99"),
    ],
)
def test_the_real_solver_refuses_in_one_line(folder, capsys, options: str, message: str) -> None:
    pytest.importorskip("torchrl", reason="needs the extra dan")
    network = dan_policy.DAN(dan_policy.DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, city_layers=1))
    dan_policy.save("mine.safetensors", network)
    assert message in refused(capsys, "solve", "square.json", *options.split())


OWN = """
import torch
from torch import nn


class Polar(nn.Module):
    in_keys = ("cities", ("game", "visits"))

    def __init__(self, width=4):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, width), nn.Tanh(), nn.Linear(width, 1))

    def forward(self, cities, visits):
        x, y = cities.unbind(-1)
        polar = torch.stack([torch.hypot(x, y), torch.atan2(y, x), visits.to(x.dtype)], dim=-1)
        return self.layers(polar)[..., 0]


def nearest(cities):
    return -cities.norm(dim=-1)


nearest.in_keys = ("cities",)


def make_nearest():
    return nearest
"""


@pytest.mark.slow
def test_a_network_of_ones_own_solves_from_a_directory_outside_the_checkout(folder, capsys, monkeypatch) -> None:
    """A module with its weights in a file, and a plain function, both from a file in the working directory."""
    pytest.importorskip("torchrl", reason="needs the extra dan")
    monkeypatch.delitem(sys.modules, "own_networks", raising=False)
    Path("own_networks.py").write_text(OWN)
    network = dan_policy.build("own_networks:Polar", {"width": 3})
    dan_policy.save("own.safetensors", network, "own_networks:Polar", {"width": 3})
    instance = read_tsplib("ten.tsp", 2)
    argv = ("solve", "ten.tsp", "--agents", "2", "--json")
    own = run(*argv, "--policy", "own.safetensors", "--network", "own_networks:Polar")
    assert (own.returncode, own.stderr) == (0, "")
    record = json.loads(own.stdout)
    check_tours(instance, record["tours"])
    assert record["tours"] == dan_policy.solve(instance, network, device="cpu").tours
    assert record["method"] == "Polar(g.)"

    assert main([*argv, "--network", "own_networks:make_nearest", "--decode", "sample", "--samples", "3"]) == 0
    record = json.loads(capsys.readouterr().out)
    check_tours(instance, record["tours"])
    assert record["method"] == "nearest(s.3)"

    message = refused(capsys, *argv, "--policy", "own.safetensors")
    assert "names the factory 'own_networks:Polar': give the network" in message

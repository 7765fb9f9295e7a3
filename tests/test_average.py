"""Averaged weights are the mean, name their sources, and are validated as during a run."""

import json
from dataclasses import asdict, replace

import pytest
import torch
from safetensors.torch import save_file

from dan_policy import DAN, DANConfig, load, save
from dan_policy.joint import JointConfig, JointDAN
from dan_policy.registry import load_extra
from train.__main__ import main
from train.presets import REFINE
from train.reinforce import reinforce

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1)


@pytest.fixture
def files(tmp_path) -> list[str]:
    torch.manual_seed(0)
    for name in ("a", "b"):
        save(tmp_path / f"{name}.safetensors", DAN(SMALL), step=name)
    return [str(tmp_path / f"{name}.safetensors") for name in ("a", "b")]


@pytest.mark.slow
def test_the_average_is_the_mean_of_every_weight(files, tmp_path):
    out = tmp_path / "new" / "mean.safetensors"
    assert main(["average", *files, files[0], "--out", str(out)]) == 0
    a, b, mean = (load(file).state_dict() for file in (*files, out))
    for name, weight in mean.items():
        assert torch.allclose(weight, (2 * a[name] + b[name]) / 3, atol=1e-6), name
    assert load(out).config == SMALL
    assert load_extra(out) == {"averaged": [{"step": "a"}, {"step": "b"}, {"step": "a"}], "shares": [1 / 3] * 3}


@pytest.mark.slow
def test_shares_carry_over_what_a_run_has_learnt(files, tmp_path):
    """The weights of a, and half of what b has learnt since c."""
    c, out = tmp_path / "c.safetensors", tmp_path / "sum.safetensors"
    save(c, DAN(SMALL), step="c")
    assert main(["average", *files, str(c), "--shares", "1", "0.5", "-0.5", "--out", str(out)]) == 0
    a, b, c, summed = (load(file).state_dict() for file in (*files, c, out))
    for name, weight in summed.items():
        assert torch.allclose(weight, a[name] + 0.5 * (b[name] - c[name]), atol=1e-6), name
    assert load_extra(out)["shares"] == [1.0, 0.5, -0.5]


@pytest.mark.slow
def test_weights_that_a_network_lacks_count_as_zero(tmp_path):
    """One network has distances, another reads service times, and a third both; whichever comes first."""
    torch.manual_seed(0)
    plain = JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1)
    both = replace(plain, distances=True, reads=("service",))
    for name, config in (("plain", plain), ("distances", replace(plain, distances=True)), ("both", both)):
        save(tmp_path / f"{name}.safetensors", JointDAN(config), step=name)
    for order in (["plain", "both", "distances"], ["distances", "plain", "both"]):
        files, out = [str(tmp_path / f"{name}.safetensors") for name in order], tmp_path / "mean.safetensors"
        assert main(["average", *files, "--shares", "0.25", "0.25", "0.5", "--out", str(out)]) == 0
        mean, states = load(out), [load(file).state_dict() for file in files]
        assert mean.config == both
        for name, weight in mean.state_dict().items():
            parts = [
                share * state[name] for share, state in zip((0.25, 0.25, 0.5), states, strict=True) if name in state
            ]
            assert torch.allclose(weight, sum(parts), atol=1e-6), name
        assert [source["step"] for source in load_extra(out)["averaged"]] == order
    save(tmp_path / "reads.safetensors", JointDAN(replace(plain, reads=("service",))))
    without_all = [str(tmp_path / f"{name}.safetensors") for name in ("distances", "reads")]
    assert main(["average", *without_all, "--out", str(tmp_path / "none.safetensors")]) == 2
    assert not (tmp_path / "none.safetensors").exists()


def test_of_networks_with_the_same_weights_the_first_says_whether_visited_cities_are_pruned(files, tmp_path):
    pruned, out = tmp_path / "pruned.safetensors", tmp_path / "mean.safetensors"
    save(pruned, DAN(replace(SMALL, prune_visited=not SMALL.prune_visited)))
    assert main(["average", str(pruned), files[0], "--out", str(out)]) == 0
    assert load(out).config == load(pruned).config != SMALL


@pytest.mark.parametrize("shares", [("1",), ("0.5", "0.4"), ("1", "1"), ("nan", "1"), ("inf", "-inf")])
def test_shares_that_do_not_add_up_are_refused(files, tmp_path, capsys, shares):
    out = tmp_path / "mean.safetensors"
    assert main(["average", *files, "--shares", *shares, "--out", str(out)]) == 2
    assert "shares must be 2 numbers, one for each file, that add up to 1, got" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_validation_is_that_of_the_runs(files, tmp_path, capsys):
    small = {"n_nodes": (10, 12), "n_agents": (2, 2), "validation_instances": 6, "tensorboard": False}
    run = reinforce(replace(REFINE, out=tmp_path / "run", init=files[0], steps=1, validate_every=1, **small))
    assert main(f"validate {tmp_path}/run/best.safetensors --n-nodes 10 12 --n-agents 2 2 --instances 6".split()) == 0
    cost, file = capsys.readouterr().out.split()
    assert float(cost) == pytest.approx(run.best, abs=1e-4) and file.endswith("best.safetensors")
    assert main(["validate", str(tmp_path / "none.safetensors")]) == main(["validate"]) == 2
    assert "name at least 1 file to validate" in capsys.readouterr().err


def test_files_without_extra_data_are_averaged(files, tmp_path):
    kept = {"format": "dan-policy-1", "config": json.dumps(asdict(SMALL))}
    save_file(load(files[0]).state_dict(), files[0], kept)
    out = tmp_path / "mean.safetensors"
    assert main(["average", *files, "--out", str(out)]) == 0
    assert load_extra(out) == {"averaged": [{}, {"step": "b"}], "shares": [0.5, 0.5]}


@pytest.mark.slow
def test_what_cannot_be_averaged_is_refused(files, tmp_path, capsys):
    out, other = tmp_path / "mean.safetensors", tmp_path / "other.safetensors"
    save(other, DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, city_layers=1)))
    for named, message in (
        (files[:1], "name at least 2 files to average, got 1"),
        ([files[0], str(other)], "other.safetensors has another configuration than"),
        ([files[0], str(tmp_path / "none.safetensors")], "none.safetensors"),
    ):
        assert main(["average", *named, "--out", str(out)]) == 2
        printed = capsys.readouterr().err
        assert message in printed and printed.count("\n") == 1
    assert not out.exists()

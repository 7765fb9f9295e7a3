"""Networks by name and on disk: what goes in comes out, nothing else is accepted, and files import no code."""

import json
import math
import pickle
import sys
from dataclasses import dataclass, fields

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from dan_policy import DAN, NETWORKS, DANConfig, build, load, registry, save
from train.network import make_network
from train.reinforce_config import ReinforceConfig

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)

OWN = """
import torch
from torch import nn


class Linear(nn.Module):
    in_keys = ("cities", "visited")

    def __init__(self, width=4):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, cities, visited):
        return self.layers(cities)[..., 0]


def rule():
    return nearest


def nearest(cities):
    return -cities.norm(dim=-1)


nearest.in_keys = ("cities",)


def nothing():
    return None


constant = 3
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "net.safetensors"
    save(path, DAN(SMALL), steps=7)
    return path


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The working directory, with a module of the user's in it that is on no path."""
    (tmp_path / "own_network.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("own_network", None)


def metadata(path):
    with safe_open(path, framework="pt") as file:
        return file.metadata()


def test_round_trip(tmp_path):
    network = DAN(SMALL)
    save(tmp_path / "a.safetensors", network, steps=7, note="ü")
    loaded = load(tmp_path / "a.safetensors")
    assert isinstance(loaded, DAN) and loaded.config == SMALL and not loaded.training
    assert all(torch.equal(loaded.state_dict()[key], value) for key, value in network.state_dict().items())
    assert registry.load_extra(tmp_path / "a.safetensors") == {"steps": 7, "note": "ü"}
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]  # no temporary file left


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_of_the_registry_is_built_and_kept_by_name(tmp_path, name):
    network = build(name)
    assert isinstance(network, NETWORKS[name].module) and isinstance(network.config, NETWORKS[name].config)
    save(tmp_path / "a.safetensors", network)
    assert json.loads(metadata(tmp_path / "a.safetensors")["network"]) == {"name": name}
    assert load(tmp_path / "a.safetensors").config == load(tmp_path / "a.safetensors", network=name).config
    with pytest.raises(ValueError, match=r"bad configuration of the network .*depth"):
        build(name, {"depth": 3})


def test_the_shipped_dans_are_of_the_first_format_and_are_read_as_before():
    for name in ("dan", "paper"):
        kept = metadata(registry.find(name))
        assert kept["format"] == "dan-policy-1"
        assert load(name).config == DANConfig(**json.loads(kept["config"]))


@pytest.mark.slow
def test_the_file_is_as_open_to_others_as_any(tmp_path):
    (tmp_path / "any").write_bytes(b"")
    save(tmp_path / "a.safetensors", DAN(SMALL))
    assert (tmp_path / "a.safetensors").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_a_failed_save_keeps_the_old_file(file, monkeypatch):
    before = file.read_bytes()

    def disk_full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(registry.Path, "write_bytes", disk_full)
    with pytest.raises(OSError, match="no space"):
        save(file, DAN(SMALL))
    assert file.read_bytes() == before and len(list(file.parent.iterdir())) == 1


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no weights at .*nowhere.*; shipped are \["):
        load(tmp_path / "nowhere")


def test_pickles_and_junk_are_refused(tmp_path):
    for name, content in {"p": pickle.dumps({"a": 1}), "empty": b"", "text": b"hello", "zeros": bytes(100)}.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}: not a safetensors file"):
            load(path)


@pytest.mark.parametrize("keep", [0.3, 0.9])
def test_a_truncated_file_is_refused(file, keep):
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(ValueError, match="not a safetensors file, or a damaged one"):
        load(file)


NAMED = '{"name": "dan"}'


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        ({}, "expected format 'dan-policy-2' in its metadata, got None"),
        ({"format": "dan-policy-1"}, "bad metadata .*config"),
        ({"format": "dan-policy-1", "config": "{", "extra": "{}"}, "bad metadata .*JSONDecodeError"),
        ({"format": "dan-policy-1", "config": "[1]"}, r"config must be a JSON object, got \[1\]"),
        ({"format": "dan-policy-1", "config": "{}", "extra": "7"}, "extra must be a JSON object, got 7"),
        ({"format": "dan-policy-1", "config": "[" * 10**5}, "bad metadata .*RecursionError"),
        ({"format": "dan-policy-1", "config": '{"depth": 3}', "extra": "{}"}, "do not fit"),
        ({"format": "dan-policy-1", "config": json.dumps({"embed_dim": 32}), "extra": "{}"}, "names and shapes"),
        ({"format": "dan-policy-2", "config": "{}"}, "bad metadata .*network"),
        ({"format": "dan-policy-2", "config": "{}", "network": "[]"}, r"network must be a JSON object, got \[\]"),
        ({"format": "dan-policy-2", "config": '{"depth": 3}', "network": NAMED}, "do not fit"),
        ({"format": "dan-policy-2", "config": "{}", "network": '{"name": [1]}'}, "do not fit"),
        ({"format": "dan-policy-2", "config": "{}", "network": '{"name": "dax"}'}, "'dax', which is none of .*'dan'"),
    ],
)
def test_other_safetensors_are_refused(tmp_path, kept, message):
    save_file(DAN(SMALL).state_dict(), tmp_path / "x", kept)
    with pytest.raises(ValueError, match=message):
        load(tmp_path / "x")


def test_a_changed_tensor_or_configuration_is_noticed(file):
    kept = metadata(file)
    tensors = load_file(file)
    name = "embed_city.weight"
    assert len(kept["checksum"]) == 64
    changes = {
        "value": (kept, tensors | {name: tensors[name] + 1e-3}),
        "dtype": (kept, tensors | {name: tensors[name].half()}),
        "name": (kept, {("x" if key == name else key): value for key, value in tensors.items()}),
        "config": (kept | {"config": kept["config"].replace("10.0", "11.0")}, tensors),
        "extra": (kept | {"extra": '{"steps": 8}'}, tensors),
        "checksum": (kept | {"checksum": "0" * 64}, tensors),
    }
    assert changes["config"][0] != kept
    for changed, values in changes.values():
        save_file(values, file, changed)
        with pytest.raises(ValueError, match="its checksum does not fit"):
            load(file)
    save_file(tensors, file, {key: value for key, value in kept.items() if key != "checksum"})
    assert load(file).config == SMALL  # as older versions wrote it


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_parameters_that_are_not_finite_are_neither_saved_nor_loaded(tmp_path, file, value):
    network = DAN(SMALL)
    with torch.no_grad():
        network.embed_city.bias[3] = value
    with pytest.raises(ValueError, match=r"'embed_city\.bias' holds NaN or infinity"):
        save(tmp_path / "a", network)
    assert not (tmp_path / "a").exists()
    kept = {key: text for key, text in metadata(file).items() if key != "checksum"}
    save_file(network.state_dict(), tmp_path / "a", kept)
    healthy = DAN(SMALL)
    before = {key: weight.clone() for key, weight in healthy.state_dict().items()}
    for target in (None, healthy):
        with pytest.raises(ValueError, match=r"a: .*'embed_city\.bias' holds NaN or infinity"):
            load(tmp_path / "a", network=target)
    assert all(torch.equal(before[key], weight) for key, weight in healthy.state_dict().items())


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_absurd_configurations_are_refused_before_anything_is_built(tmp_path, name, monkeypatch):
    """Every size and clip of every network of the registry; ``view`` costs nothing."""
    kind = NETWORKS[name]
    save(tmp_path / "a", build(name, {"embed_dim": 16, "n_heads": 2}))
    kept, tensors = metadata(tmp_path / "a"), load_file(tmp_path / "a")
    kept.pop("checksum")
    monkeypatch.setitem(NETWORKS, name, registry.NetworkType(kind.config, lambda config: pytest.fail("it was built")))
    for field in fields(kind.config):
        for value in (10**7, 20_000.5, math.inf, math.nan, -1, "7", [], None):
            if (field.name, value) in (("view", 10**7), ("view", None), ("confidence", None), ("reads", [])):
                continue
            config = json.loads(kept["config"]) | {field.name: value}
            save_file(tensors, tmp_path / "a", kept | {"config": json.dumps(config)})
            if field.name == "tanh_clip" and value == 20_000.5:
                continue
            with pytest.raises(
                ValueError, match=rf"a: weights and network do not fit \(.*{field.name.partition('_')[2]}"
            ):
                load(tmp_path / "a")


@pytest.mark.slow
def test_wide_networks_take_no_memory_before_the_tensors_are_compared(tmp_path, file):
    """10^12 parameters would take 4 TB."""
    config = {"embed_dim": 16_384, "feedforward_dim": 16_384, "city_layers": 1000, "n_heads": 1}
    save_file(load_file(file), tmp_path / "a", {"format": "dan-policy-1", "config": json.dumps(config)})
    with pytest.raises(ValueError, match="its tensors do not have the names and shapes of the network 'dan'"):
        load(tmp_path / "a")


@pytest.mark.parametrize("device", ["meta", "cpu:99", "nowhere", "hpu"])
def test_devices_that_cannot_compute_are_named(file, device):
    with pytest.raises(ValueError, match=f"no device '{device}' here; choose for example 'cpu'"):
        load(file, device)


# Networks of one's own


def test_a_network_of_the_working_directory_is_built_kept_and_loaded(own):
    paths = list(sys.path)
    network = build("own_network:Linear", {"width": 3})
    assert sys.path == paths
    save("a.safetensors", network, "own_network:Linear", {"width": 3}, steps=1)
    loaded = load("a.safetensors", network="own_network:Linear")
    assert type(loaded) is type(network) and not loaded.training
    assert all(torch.equal(loaded.state_dict()[key], value) for key, value in network.state_dict().items())
    given = build("own_network:Linear", {"width": 3})
    assert load("a.safetensors", network=given) is given
    with pytest.raises(ValueError, match="do not fit"):
        load("a.safetensors", network=build("own_network:Linear"))


def test_a_file_does_not_decide_what_is_imported(own):
    save("a.safetensors", build("own_network:Linear"), "own_network:Linear")
    del sys.modules["own_network"]
    for network in (None, "dan"):
        with pytest.raises(ValueError, match="names the factory 'own_network:Linear': give the network"):
            load("a.safetensors", network=network)
    save("b.safetensors", nn.Linear(2, 2))
    with pytest.raises(ValueError, match="holds weights alone: give the network"):
        load("b.safetensors")
    assert "own_network" not in sys.modules


def test_a_file_of_a_registered_network_takes_no_other(own, file):
    with pytest.raises(ValueError, match="it holds the network 'dan', not 'own_network:Linear'"):
        load(file, network="own_network:Linear")
    assert "own_network" not in sys.modules


def test_a_plain_function_is_built_as_a_module(own):
    network = build("own_network:rule")
    cities = torch.rand(3, 5, 2)
    assert network.in_keys == ("cities",)
    assert torch.equal(network(cities), -cities.norm(dim=-1))
    save("rule.safetensors", network, "own_network:rule")
    assert torch.equal(load("rule.safetensors", network="own_network:rule")(cities), network(cities))
    with pytest.raises(TypeError, match=r"network must be a torch\.nn\.Module, got function"):
        save("rule.safetensors", sys.modules["own_network"].nearest)


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("dax", None, r"network must be one of \[.*'dan'.*\] or package.module:factory, got 'dax' \(no colon in it\)"),
        ("own_network:Missing", None, "got 'own_network:Missing'"),
        ("nowhere_at_all:Linear", None, "No module named 'nowhere_at_all'"),
        ("own_network:constant", None, "own_network:constant must be callable, got int"),
        ("own_network:nothing", None, "own_network:nothing must return a module or a function, got NoneType"),
        ("own_network:Linear", {"depth": 3}, "cannot be called with the configuration {'depth': 3}"),
        ("dan", {"n_heads": 3}, "n_heads must divide"),
    ],
)
def test_networks_that_cannot_be_built_are_named(own, name, config, message):
    with pytest.raises(ValueError, match=message):
        build(name, config)


def test_loading_draws_no_random_numbers(file):
    before = torch.get_rng_state()
    load(file)
    assert torch.equal(torch.get_rng_state(), before)


@dataclass(frozen=True)
class ScaleConfig:
    scale: float = 2.0


class Scale(nn.Module):
    in_keys = ("cities",)

    def __init__(self, config: ScaleConfig):
        super().__init__()
        self.config = config


def test_a_newly_registered_network_is_trained_with_its_own_defaults(monkeypatch):
    monkeypatch.setitem(NETWORKS, "scale", registry.NetworkType(ScaleConfig, Scale))
    assert make_network(ReinforceConfig(policy="scale")).config == ScaleConfig()

"""Networks on disk: what goes in comes out, and nothing but such files is accepted."""

import json
import pickle

import pytest
import torch
from safetensors.torch import save_file

from dan_policy import DAN, DANConfig, load, save, weights

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "net.safetensors"
    save(path, DAN(SMALL), steps=7)
    return path


def test_round_trip(tmp_path):
    network = DAN(SMALL)
    save(tmp_path / "a.safetensors", network, steps=7, note="ü")
    loaded = load(tmp_path / "a.safetensors")
    assert loaded.config == SMALL and not loaded.training
    assert all(torch.equal(loaded.state_dict()[key], value) for key, value in network.state_dict().items())
    assert weights.load_extra(tmp_path / "a.safetensors") == {"steps": 7, "note": "ü"}
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]  # no temporary file left


def test_the_file_is_as_open_to_others_as_any(tmp_path):
    (tmp_path / "any").write_bytes(b"")
    save(tmp_path / "a.safetensors", DAN(SMALL))
    assert (tmp_path / "a.safetensors").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_a_failed_save_keeps_the_old_file(file, monkeypatch):
    before = file.read_bytes()

    def disk_full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(weights.Path, "write_bytes", disk_full)
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


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({}, "expected format 'dan-policy-1' in its metadata, got None"),
        ({"format": "dan-policy-1"}, "do not fit"),
        ({"format": "dan-policy-1", "config": "{", "extra": "{}"}, "do not fit"),
        ({"format": "dan-policy-1", "config": '{"depth": 3}', "extra": "{}"}, "do not fit"),
        ({"format": "dan-policy-1", "config": json.dumps({"embed_dim": 32}), "extra": "{}"}, "do not fit"),
    ],
)
def test_other_safetensors_are_refused(tmp_path, metadata, message):
    save_file(DAN(SMALL).state_dict(), tmp_path / "x", metadata)
    with pytest.raises(ValueError, match=message):
        load(tmp_path / "x")

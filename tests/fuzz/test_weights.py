"""Weights: a file is read whole or refused with its name, whatever is wrong with it."""

import json

import pytest
import torch
from helpers.broken import broken
from hypothesis import given, settings
from hypothesis import strategies as st

from dan_policy import DAN, DANConfig, load, save

pytestmark = pytest.mark.fuzz

DTYPES = st.sampled_from(["F64", "F32", "F16", "BF16", "I64", "I32", "U8", "BOOL", "F8_E4M3", "C64", "F4", "X"])
JSON = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.integers(), max_size=2)
SMALL = DANConfig(embed_dim=4, feedforward_dim=4, n_heads=2, city_layers=1)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A file of weights, which the tests overwrite."""
    path = tmp_path_factory.mktemp("fuzz") / "net.safetensors"
    save(path, DAN(SMALL), steps=7)
    return path


@pytest.fixture(scope="module")
def whole(file):
    return file.read_bytes()


def read(file, data):
    """Read ``data`` as weights: the network, or None if they are refused by name."""
    file.write_bytes(data)
    try:
        return load(file)
    except ValueError as error:
        assert str(file) in str(error)
        return None


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(file, whole, data):
    """What is read although its bytes are broken has the weights and the configuration that were written."""
    network = read(file, data.draw(broken(whole)))
    if network is not None:
        file.write_bytes(whole)
        original = load(file)
        assert network.config == original.config
        assert all(map(torch.equal, network.state_dict().values(), original.state_dict().values()))


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_headers_without_a_checksum(file, whole, data):
    """Older files have none. The header says how long it is, so that broken bytes rarely get further than that."""
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])
    metadata = header["__metadata__"]
    del metadata["checksum"]
    if data.draw(st.booleans()):
        key = data.draw(st.sampled_from(sorted(metadata)))
        text = data.draw(broken(metadata[key].encode()) | st.text().map(str.encode))
        metadata[key] = text.decode(errors="replace")
    else:
        config = json.loads(metadata["config"])
        config[data.draw(st.sampled_from(sorted(config)))] = data.draw(JSON)
        metadata["config"] = json.dumps(config)
    if data.draw(st.booleans()):
        tensor = header[data.draw(st.sampled_from(sorted(header.keys() - {"__metadata__"})))]
        tensor[data.draw(st.sampled_from(sorted(tensor)))] = data.draw(DTYPES | st.lists(st.integers(-1, 99)))
    changed = json.dumps(header).encode()
    changed += b" " * (-len(changed) % 8)
    read(file, len(changed).to_bytes(8, "little") + changed + whole[8 + length :])

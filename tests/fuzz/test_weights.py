"""Weights: a file is read whole or refused with its name, whatever is wrong with it."""

import json

import pytest
from helpers.broken import broken
from hypothesis import given, settings
from hypothesis import strategies as st

from dan_policy import DAN, DANConfig, load, save

pytestmark = pytest.mark.fuzz

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


@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(file, whole, data):
    read(file, data.draw(broken(whole)))


@given(data=st.data())
@settings(deadline=None)
def test_broken_metadata(file, whole, data):
    """The header says how long the metadata are, so that broken bytes in them rarely get further than the header."""
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])
    key = data.draw(st.sampled_from(sorted(header["__metadata__"])))
    text = data.draw(broken(header["__metadata__"][key].encode()) | st.text().map(str.encode))
    header["__metadata__"][key] = text.decode(errors="replace")
    changed = json.dumps(header).encode()
    changed += b" " * (-len(changed) % 8)
    read(file, len(changed).to_bytes(8, "little") + changed + whole[8 + length :])

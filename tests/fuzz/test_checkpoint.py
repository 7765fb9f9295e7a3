"""Training checkpoints: a file is read as it was written, or refused with its name and a way out."""

import hashlib
import io

import pytest
import torch
from helpers.broken import broken
from helpers.states import same
from hypothesis import given, settings
from hypothesis import strategies as st

from train import checkpoint

pytestmark = pytest.mark.fuzz

STATE = {
    "config": {"out": "runs/x", "steps": 3},
    "network": {"weight": torch.arange(6.0).reshape(2, 3), "bias": torch.ones(2, dtype=torch.float64)},
    "random": {"numpy": {"state": 2**100}, "cuda": []},
    "progress": {"best": float("inf"), "step": 2},
}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A checkpoint, which the tests overwrite."""
    path = tmp_path_factory.mktemp("fuzz") / "checkpoint.pt"
    checkpoint.write(path, STATE)
    return path


@pytest.fixture(scope="module")
def whole(path):
    return path.read_bytes()


@pytest.fixture(scope="module")
def without_checksum():
    """The same state as older versions wrote it."""
    content = io.BytesIO()
    torch.save(STATE, content)
    return content.getvalue()


def read(path, data):
    """Read ``data`` as a checkpoint: the state, or None if it is refused by name."""
    path.write_bytes(data)
    try:
        return checkpoint.read(path)
    except ValueError as error:
        assert str(path) in str(error) and "--init" in str(error)
        return None


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(path, whole, data):
    changed = data.draw(broken(whole))
    state = read(path, changed)
    assert (state is not None) == (changed == whole)


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes_of_an_older_file(path, without_checksum, data):
    """The checksums of its ZIP archive cover the content of its parts."""
    state = read(path, data.draw(broken(without_checksum)))
    assert state is None or same(state, STATE)


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_content_with_a_checksum_that_fits(path, without_checksum, data):
    """What an unpickler may meet, whoever wrote it."""
    content = data.draw(broken(without_checksum))
    read(path, checkpoint.MAGIC + hashlib.sha256(content).digest() + content)

"""A checkpoint is read as it was written or refused with the way out; the one before it is kept."""

import hashlib
import io
import random

import pytest
import torch
from helpers.states import same

from train import checkpoint

STATE = {"a": torch.arange(20.0), "b": {"c": [1, 2.5, "x", None]}, "step": 3}


@pytest.fixture
def path(tmp_path):
    checkpoint.write(tmp_path / "checkpoint.pt", STATE)
    return tmp_path / "checkpoint.pt"


def test_what_is_written_is_read(path):
    assert same(checkpoint.read(path), STATE)
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]


@pytest.mark.slow
def test_every_flipped_bit_is_noticed(path):
    """The first bytes bit by bit, the rest at random."""
    whole = path.read_bytes()
    rng = random.Random(0)
    bits = [*range(8 * 100), *(rng.randrange(8 * len(whole)) for _ in range(500))]
    for bit in bits:
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"checkpoint\.pt: not a checkpoint, or a damaged one"):
            checkpoint.read(path)


@pytest.mark.parametrize("data", [b"", b"hello", checkpoint.MAGIC, b"PK\x03\x04" + bytes(100)])
def test_other_files_are_refused(path, data):
    path.write_bytes(data)
    with pytest.raises(ValueError, match="not a checkpoint, or a damaged one"):
        checkpoint.read(path)


def test_the_previous_one_is_kept_and_named(path):
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"start another run, from .*: --init .*last\.safetensors"):
        checkpoint.read(path)
    checkpoint.write(path, STATE)
    checkpoint.write(path, STATE | {"step": 4})
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"continue from the checkpoint before it: mv .*previous\.pt .*checkpoint\.pt"):
        checkpoint.read(path)
    assert same(checkpoint.read(checkpoint.previous(path)), STATE)


def test_an_older_checkpoint_without_a_checksum_is_read_unless_its_own_checksums_fail(path):
    torch.save(STATE, path)
    assert same(checkpoint.read(path), STATE)
    data = bytearray(path.read_bytes())
    data[data.index(STATE["a"].numpy().tobytes())] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"the checksum of its part 'checkpoint/data/.*' does not fit"):
        checkpoint.read(path)


def test_a_file_that_holds_something_else_is_refused(path):
    content = io.BytesIO()
    torch.save([1, 2], content)
    path.write_bytes(checkpoint.MAGIC + hashlib.sha256(content.getvalue()).digest() + content.getvalue())
    with pytest.raises(ValueError, match="not a checkpoint: it holds a list"):
        checkpoint.read(path)

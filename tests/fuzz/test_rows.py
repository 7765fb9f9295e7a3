"""Rows of benchmark results: a broken line is read as a row of the right types, or refused with file and line."""

import json
from dataclasses import asdict, fields

import pytest
from helpers.broken import broken
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import one_agent_does_it_all, row

from benchmarks import suite
from benchmarks.harness import rows
from benchmarks.harness.judge import read_judged

pytestmark = pytest.mark.fuzz

CELL = suite.cells("smoke")[0]
INSTANCE = CELL.instances(7)[0]
ROW = asdict(row(INSTANCE, one_agent_does_it_all(INSTANCE), 0))
LINE = json.dumps(ROW).encode()
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Where the tests write their files."""
    return tmp_path_factory.mktemp("fuzz") / "rows.jsonl"


def check(path, line):
    """Read ``line`` after a good one, as ``report`` and ``best --merge`` do."""
    path.write_bytes(LINE + b"\n" + line + b"\n")
    try:
        results = list(read_judged([path]))
    except ValueError as error:
        assert f"{path}:" in str(error)
        return
    for result in results:
        assert type(result.instance) is type(result.seed) is int and 0 <= result.instance < suite.MOST_INSTANCES
        assert result.seconds >= 0 and isinstance(result.machine, dict) and isinstance(result.versions, dict)
        assert rows.parse(json.dumps(asdict(result))) == result


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(path, data):
    check(path, data.draw(broken(LINE)))


@pytest.mark.slow
@given(field=st.sampled_from([field.name for field in fields(rows.Row)]), value=VALUES)
@settings(deadline=None)
def test_any_value_of_a_field(path, field, value):
    check(path, json.dumps({**ROW, field: value}).encode())

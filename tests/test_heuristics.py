"""What ``solve`` chooses by itself: how sharp samples are, how far agents see, and when bfloat16 pays."""

import pytest
import torch

from dan_policy import heuristics


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [
        ({"amx_bf16": True}, True),
        ({"avx512_bf16": True}, True),
        ({"avx512_bf16": True, "cpu_name": "AMD EPYC"}, True),
        ({"avx512_bf16": True, "cpu_name": "Intel Xeon"}, False),
        ({"avx512_bf16": True, "amx_bf16": True, "cpu_name": "Intel Xeon"}, True),
        ({"amx_bf16": False, "avx512_f": True}, False),
        ({}, False),
    ],
)
def test_matrix_units_are_those_that_the_cpu_reports(monkeypatch, capabilities, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    multiplies = heuristics.multiplies_bfloat16.__wrapped__  # the answer for this machine is cached
    assert multiplies(torch.device("cpu")) is expected
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert multiplies(torch.device("cpu")) is False  # an older torch does not report them


def test_samples_are_sharper_the_longer_the_game():
    """Sec. 6.1: C = 10, and 100 from n = 500 on; between them, in proportion."""
    assert [heuristics.sampling_clip(10.0, n) for n in (2, 50, 100, 200, 500, 5000)] == [10, 10, 20, 40, 100, 100]
    assert [heuristics.sampling_clip(200.0, n) for n in (20, 1000)] == [
        200.0,
        200.0,
    ]  # never flatter than it was trained
    assert heuristics.sampling_clip(5.0, 100) == 10.0
    assert [heuristics.sampling_clip(10.0, n, augment=True) for n in (10, 50, 100, 400)] == [10, 30, 60, 100]


def test_large_instances_are_seen_in_part():
    assert [heuristics.default_view(n) for n in (2, 399, 400, 5000)] == [None, None, 100, 100]


@pytest.mark.parametrize("hardware", [True, False])
def test_bfloat16_pays_on_hardware_that_has_it_and_for_many_nodes(monkeypatch, hardware):
    monkeypatch.setattr(heuristics, "multiplies_bfloat16", lambda device: hardware)
    assert [heuristics.bfloat16_pays(torch.device("cpu"), nodes) for nodes in (499, 500)] == [False, hardware]

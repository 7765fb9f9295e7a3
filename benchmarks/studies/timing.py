"""What the studies of speed share: rates, the machine's rate of floating-point operations, and its description."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.harness.machine import describe_machine


def machine_title(device: str = "cpu") -> str:
    """Processor, cores and versions, for the title of a table."""
    machine = describe_machine()
    gpu = f", {torch.cuda.get_device_name()}" if device == "cuda" else ""
    return (
        f"{machine['processor']}, {machine['cores']} cores{gpu}; Python {machine['python']}, NumPy {np.__version__}, "
        f"torch {torch.__version__} with {torch.get_num_threads()} threads"
    )


def per_second(work: Callable[[], int], seconds: float, wait: Callable[[], None] = lambda: None) -> float:
    """Units done per second.

    Args:
        work: does some units of work and returns how many; it is called once to warm up.
        seconds: time to measure for.
        wait: called after each round; waits until the device has finished its work.
    """
    work()
    wait()
    units, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        units += work()
        wait()
    return units / elapsed


def wait_for(device: str) -> Callable[[], None]:
    """A function that waits until the device has finished its work."""
    return torch.cuda.synchronize if device == "cuda" else lambda: None


def matmul_rate(device: str) -> float:
    """FLOP/s of a large float32 matrix product, the upper limit for networks."""
    a = torch.randn(2048, 2048, device=device)

    def multiply() -> int:
        a @ a
        return 2 * 2048**3

    return per_second(multiply, 1.0, wait_for(device))

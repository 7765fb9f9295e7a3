"""Several processes, one training: what ``torchrun`` starts, each with its own batches (gloo on CPUs, NCCL on GPUs).

In a single process, without ``torchrun``, every function here is the identity.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn


@contextmanager
def processes(device: str) -> Iterator[None]:
    """Join the group that ``torchrun`` describes in the environment variables; leave it at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or dist.is_initialized():
        yield
        return
    if torch.device(device).type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if torch.device(device).type == "cuda" else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """This process's number. Process 0 writes logs and weights."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """The number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def average_gradients(network: nn.Module) -> None:
    """Replace every gradient by its mean over the processes, in one message.

    If the processes' losses are means over equally many episodes, that is the gradient of one process with all of them.
    (The backward pass runs in chunks, whose number differs between processes, so communication cannot overlap with it.)
    """
    if world_size() == 1:
        return
    gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in network.parameters()]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= world_size()
    for parameter, part in zip(network.parameters(), flat.split([g.numel() for g in gradients]), strict=True):
        parameter.grad = part.view_as(parameter)


def gather(values: Tensor) -> Tensor:
    """(K * N,) The values (N,) of all K processes, in the same order in each of them."""
    if world_size() == 1:
        return values
    parts = [torch.empty_like(values) for _ in range(world_size())]
    dist.all_gather(parts, values.contiguous())
    return torch.cat(parts)


def any_process(flag: bool, device: str) -> bool:
    """Whether ``flag`` is set in any process, so that all of them end a run after the same step."""
    if world_size() == 1:
        return flag
    votes = torch.tensor([float(flag)], device=device)
    dist.all_reduce(votes)
    return bool(votes > 0)

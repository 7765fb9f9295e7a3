"""From an instance to tours in one call."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict
from torch import nn

from dan_policy import single
from dan_policy.actor import make_actor
from dan_policy.episode import Decode, find_device, rollout
from dan_policy.network import DAN
from dan_policy.symmetry import SYMMETRIES, views
from dan_policy.weights import find, load
from mtsp_env import rules
from mtsp_env.batched import BatchedMTSP
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours, batch
from mtsp_env.tours import check_prefixes, check_tours, makespan

Precision = Literal["auto", "float32", "bfloat16"]
SPEED = 0.01  # the paper's Delta g in tests (Sec. 6)
SHARP_CLIP = 100.0
LARGE, LOCAL_VIEW = 400, 100  # from so many nodes on, so many cities are seen
ENOUGH = 500  # nodes side by side from which bfloat16 pays on a CPU that multiplies such matrices


@dataclass(frozen=True)
class Solution:
    """What ``solve`` found.

    Attributes:
        tours: one per agent, each from depot to depot.
        makespan: the longest tour, in unit-square units; times ``instance.scale`` it is in the source's.
        seconds: wall-clock time of the planning, improvement included, without loading weights or compiling kernels.
        method: for tables, e.g. "dan(g.)", "dan(s.64)", "dan(g.x8)" (augmented) or "dan(g.)+improve(1 s)".
    """

    tours: Tours
    makespan: float
    seconds: float
    method: str


def solve(
    instance: Instance,
    policy: str | os.PathLike | nn.Module = "default",
    decode: Decode = "greedy",
    samples: int = 64,
    seed: int = 0,
    device: torch.device | str | None = None,
    improve: float | None = None,
    precision: Precision = "auto",
    augment: bool = False,
    clip: float | None = None,
    view: int | None = None,
    prefixes: Sequence[Sequence[int]] | None = None,
) -> Solution:
    """Plan the team's tours with a policy (paper, Sec. 6: DAN(g.) and DAN(s.64)), and polish them where asked to.

    The games are played with the depot rule "final", so that tours are complete whatever the policy does. With
    ``prefixes`` they go on from there: for who has to replan a team that is under way.

    Args:
        policy: the name of a shipped model, a file that ``dan_policy.save`` wrote, a ``DAN``, or any actor built by
            ``make_actor``.
        decode: "greedy": one game of likeliest actions. "sample": ``samples`` games of drawn ones, the best counts;
            of a DAN with the C of ``sample_clip``.
        samples: games played side by side where ``decode`` is "sample", at least 1.
        seed: of the samples and of the improvement; without the latter, which goes by the clock, the same call gives
            the same tours on the same machine.
        device: None takes a GPU where there is one.
        improve: seconds, above 0, for which ``mtsp_env.reference.improve`` goes on from the policy's tours; it never
            makes them worse (extra ``reference``). None: the tours stay as they are.
        precision: of the network's matrix products. "auto": "bfloat16" where the device has units for it and the games
            hold enough nodes to gain (about twice as fast for 64 samples on CPUs with AMX or AVX-512 BF16, equally good
            tours), for a DAN; "float32" elsewhere, and for tours that do not depend on the device.
        clip: C to sample with, above 0: the larger, the surer the likelier actions are drawn. None: ``sample_clip``.
        view: how many cities a deciding agent sees at most, the nearest unvisited ones, at least 1: the fewer, the
            sooner a plan is there. For a DAN with ``prune_visited``. None: its configuration's, else ``default_view``,
            which is for policies taught on small instances: one taught on larger ones wants ``view=n_nodes``.
        augment: the games see the instance in the square's eight symmetries in turn, and the best counts (Kwon et al.
            2020, POMO): "greedy" plays eight games instead of one, "sample" as many as without.
        prefixes: how each agent's tour begins (``mtsp_env.tours.check_prefixes``); None: all are at the depot. Each is
            driven at once, and whoever is first at the end of its prefix decides first.

    Raises:
        ImportError: ``improve`` without Numba.
        OSError: no such weights.
        ValueError: bad weights, or an argument outside its range.
    """
    check_count("samples", samples, minimum=1)
    if decode not in ("greedy", "sample"):
        raise ValueError(f"unknown decode {decode!r}; choose from ['greedy', 'sample']")
    if precision not in get_args(Precision):
        raise ValueError(f"unknown precision {precision!r}; choose from {list(get_args(Precision))}")
    if clip is not None and not clip > 0:
        raise ValueError(f"clip must be above 0, got {clip!r}")
    if view is not None:
        check_count("view", view, minimum=1)
    prefixes = None if prefixes is None else check_prefixes(instance, prefixes)
    polish = None if improve is None else _polish(improve, seed, prefixes)
    device = find_device(device)
    policy = _ready(policy, device)
    if isinstance(policy, DAN):
        own = policy.config
        if decode == "sample":
            policy = _with(policy, tanh_clip=clip or sample_clip(own.tanh_clip, instance.n_nodes, augment))
        if view is not None or (own.prune_visited and own.view is None):
            policy = _with(policy, view=view or default_view(instance.n_nodes))
    elif view is not None:
        raise ValueError(f"view must be None for a policy that is no DAN, got {view!r}")

    rows = samples if decode == "sample" else SYMMETRIES if augment else 1
    if precision == "auto":
        gains = isinstance(policy, DAN) and _multiplies_bfloat16(device) and rows * _seen(policy, instance) >= ENOUGH
        precision = "bfloat16" if gains else "float32"

    start = time.perf_counter()
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        game = rules.make_rules(instance.n_nodes, instance.n_agents, SPEED, "final", "sparse", None)
        state = _set_out(instance, game, prefixes or [])
        if rules.all_visited(state)[0]:
            tours = rules.tours(state.visits[0], state.destination[0])
        elif rows == 1 and decode == "greedy" and precision == "float32" and single.can_play(policy, device):
            tours = single.play(policy, state, game)
        else:
            tours = _play(policy, _side_by_side(state, rows, augment, device), decode, seed)
    if polish is not None:
        tours = polish(instance, tours)
    seconds = time.perf_counter() - start

    check_tours(instance, tours)
    method = f"dan({'g.' if decode == 'greedy' else f's.{samples}'}{'x8' if augment else ''})"
    if polish is not None:
        method += f"+improve({improve:g} s)"
    return Solution(tours, makespan(instance, tours), seconds, method)


@cache
def _multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 faster than float32."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    cpu = getattr(torch.cpu, "get_capabilities", dict)() if device.type == "cpu" else {}
    return bool(cpu.get("amx_bf16") or cpu.get("avx512_bf16"))


def _polish(seconds: float, seed: int, prefixes: Tours | None) -> Callable[[Instance, Tours], Tours]:
    """The reference solver for so many seconds, ready to start."""
    from mtsp_env import reference  # Numba: only where it is needed

    check_seconds("improve", seconds)
    check_count("seed", seed, minimum=0)
    reference.compile_kernels()
    return partial(reference.improve, seconds=seconds, seed=seed, prefixes=prefixes)


def _set_out(instance: Instance, game: rules.Rules, prefixes: Tours) -> rules.State:
    """The moment (one row of NumPy arrays) when all ``prefixes`` are driven, by the game's own rules and clock."""
    state, left = rules.start(batch([instance])), [prefix[1:] for prefix in prefixes]
    while any(left):
        agent = min((a for a in range(len(left)) if left[a]), key=lambda a: (state.ready[0, a], a))
        action, *left[agent] = left[agent]
        state = rules.depart(state, game, np.array([action]), np.array([agent]))
    return state


def _side_by_side(state: rules.State, rows: int, augment: bool, device: torch.device) -> TensorDict:
    """The same state in so many rows, as the batched environment takes it; in the square's symmetries in turn."""
    parts = {name: torch.tensor(part, device=device) for name, part in state.arrays().items()}
    game = TensorDict(parts, batch_size=[1], device=device).expand(rows).contiguous()
    if augment:
        nodes = views(parts["nodes"][0], rows)
        game.update({"nodes": nodes, "seen_nodes": nodes.to(torch.float32)})
    return TensorDict({"game": game}, batch_size=[rows], device=device)


def _play(policy: nn.Module, start: TensorDict, decode: Decode, seed: int) -> Tours:
    """The best game from ``start``, whose rows are all the same state."""
    actor = make_actor(policy) if isinstance(policy, DAN) else policy
    (rows, n_nodes), n_agents, device = start["game", "visited"].shape, start["game", "ready"].shape[1], start.device
    env = BatchedMTSP(n_nodes, n_agents, [rows], SPEED, depot="final", device=device, check_actions=False)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        last = rollout(actor, env, decode, start).last
    best = env.makespan(last).argmin()[None]
    return env.tours(last[best])[0]


def _ready(policy: str | os.PathLike | nn.Module, device: torch.device) -> nn.Module:
    """A DAN, or an actor, on its device."""
    if not isinstance(policy, nn.Module):
        file = find(policy)
        policy = _loaded(file, file.stat().st_mtime_ns, device)
    return policy.to(device).eval() if isinstance(policy, DAN) else policy.to(device)


def sample_clip(clip: float, n_nodes: int, augment: bool = False) -> float:
    """C to sample with, for a policy trained with C = ``clip``: larger logits for longer games.

    The more decisions a game has, the surer each must be for a whole sample to be good. The paper keeps its C = 10 for
    small instances and takes 100 from n = 500 on (Sec. 6.1); here C grows with n between these two, n / 5. Augmented
    games differ without chance, too: they are three times as sure.
    """
    return max(clip, min(SHARP_CLIP, clip * n_nodes / 50 * (3 if augment else 1)))


def _seen(network: DAN, instance: Instance) -> int:
    """Nodes in view at most."""
    return min(instance.n_nodes, 1 + (network.config.view or instance.n_nodes))


def default_view(n_nodes: int) -> int | None:
    """How many cities an agent sees, of a policy taught on up to 100 nodes; None: all.

    From ``LARGE`` nodes on, more cities than it was taught with do not help it (``python -m benchmarks view``).
    """
    return LOCAL_VIEW if n_nodes >= LARGE else None


def _with(network: DAN, **changes: Any) -> DAN:
    """The same weights with another configuration: of what leaves their shapes alone."""
    other = copy(network)  # shares the parameters
    other.config = replace(network.config, **changes)
    return other


@lru_cache(maxsize=4)
def _loaded(file: os.PathLike, _changed: int, device: torch.device) -> DAN:
    """Weights are read once per process and file version: who replans every second should not wait for the disk."""
    network = load(file, device)
    if device.type == "cpu":
        for layer in network.modules():
            if isinstance(layer, nn.Linear):  # in memory by columns: products of a few rows are faster, up to twice
                layer.weight.data = layer.weight.data.t().contiguous().t()
    return network

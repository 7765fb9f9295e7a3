"""From an instance to tours in one call."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch
from torch import nn

from dan_policy.games import begin, best_tours, play
from dan_policy.heuristics import bfloat16_pays, default_view, sampling_clip
from dan_policy.layers import check_confidence
from dan_policy.network import Decode, Network, find_device, is_actor
from dan_policy.reconstruct import GAMES, reconstruct
from dan_policy.registry import find, load, network_name
from dan_policy.symmetry import SYMMETRIES
from mtsp_env import rules
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours, check_plannable
from mtsp_env.machine import check_memory
from mtsp_env.tours import check_prefixes, check_tours, makespan

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

Precision = Literal["auto", "float32", "bfloat16"]
BYTES_PER_AGENT = 200  # of its tour as a list
BYTES_PER_GAME_AND_NODE = 100  # of the state of a game, for each of its nodes and agents; networks need far more
SPEED = 0.01  # distance per tick (the paper's Delta g in tests, Sec. 6)


@dataclass(frozen=True)
class Solution:
    """The tours that ``solve`` planned.

    Attributes:
        tours: one per agent, each from depot to depot.
        makespan: the longest tour, in unit-square units; times ``instance.scale`` it is in the source's.
        seconds: wall-clock time of the planning, improvement included, without loading weights or compiling kernels.
        method: for tables, e.g. "dan(g.)", "dan(s.64)", "dan(g.x8)" (augmented), "dan(g.x8)+reconstruct(16)" or
            "dan(g.)+improve(1 s)".
    """

    tours: Tours
    makespan: float
    seconds: float
    method: str


@dataclass(frozen=True)
class SolveOptions:
    """How ``solve`` plans.

    ``clip``, ``view``, ``prune_visited`` and ``confidence`` need a network whose ``config`` has these fields.

    Attributes:
        decode: "greedy" plays one game of likeliest actions; "sample" plays ``samples`` games of drawn actions and
            takes the best (paper, Sec. 6: DAN(g.) and DAN(s.64)).
        samples: games to sample, at least 1.
        augment: the games see the instance in the square's eight symmetries in turn, and the best counts (Kwon et al.
            2020, POMO): "greedy" plays eight games instead of one, "sample" as many as without.
        reconstruct: rounds in which the policy plans parts of the best tours again (``dan_policy.reconstruct``); it
            never makes them worse. 0 leaves them as they are.
        seed: seed of the samples, of the re-construction and of the improvement, from 0 to 2^63 - 1. The same call
            gives the same tours on the same machine, except with ``improve``, which goes by the clock.
        device: None takes a GPU if there is one.
        improve: seconds, above 0, for which ``mtsp_env.reference.improve`` continues from the policy's tours; it never
            makes them worse (extra ``reference``). None leaves the tours as they are.
        precision: precision of the network's matrix products. "auto" takes "bfloat16" if the network supports it and
            ``heuristics.bfloat16_pays`` (about twice as fast for 64 samples on CPUs with AMX or AMD's AVX-512 BF16,
            equally good tours), else "float32", whose tours do not depend on the hardware.
        clip: C to sample with, above 0: the larger it is, the more often the likelier actions are drawn. None:
            ``heuristics.sampling_clip``.
        view: how many cities a deciding agent sees at most, the nearest unvisited ones, at least 1; seeing fewer is
            faster. A DAN needs ``prune_visited`` for it. None: the network's own, or else ``heuristics.default_view``,
            which suits networks trained on small instances; one trained on larger ones wants ``view=n_nodes``.
        prune_visited: whether visited cities are dropped before the encoders. None: as the network was trained.
        confidence: a network that foresees where all agents go next (``JointDAN``) lets the next agents act on that if
            its probability is above this, at most 1; each of them would look for itself otherwise. 1: each agent always
            looks for itself. None: as the network's own config says.

    Raises:
        ValueError: a value outside its range.
    """

    decode: Decode = "greedy"
    samples: int = 64
    augment: bool = False
    reconstruct: int = 0
    seed: int = 0
    device: torch.device | str | None = None
    improve: float | None = None
    precision: Precision = "auto"
    clip: float | None = None
    view: int | None = None
    prune_visited: bool | None = None
    confidence: float | None = None

    def __post_init__(self) -> None:
        for name, choices in (("decode", get_args(Decode)), ("precision", get_args(Precision))):
            if getattr(self, name) not in choices:
                raise ValueError(f"unknown {name} {getattr(self, name)!r}; choose from {list(choices)}")
        check_count("samples", self.samples, minimum=1)
        check_count("reconstruct", self.reconstruct, minimum=0)
        check_count("seed", self.seed, minimum=0)
        if self.seed >= 2**63:
            raise ValueError(f"seed must be below 2^63, got {self.seed}")
        if self.improve is not None:
            check_seconds("improve", self.improve)
        if self.clip is not None and not self.clip > 0:
            raise ValueError(f"clip must be above 0, got {self.clip!r}")
        if self.view is not None:
            check_count("view", self.view, minimum=1)
        check_confidence(self.confidence)

    @property
    def games(self) -> int:
        """Games played side by side."""
        return self.samples if self.decode == "sample" else SYMMETRIES if self.augment else 1


def solve(
    instance: Instance,
    policy: str | os.PathLike[str] | Network | TensorDictModuleBase = "default",
    options: SolveOptions | None = None,
    *,
    prefixes: Sequence[Sequence[int]] | None = None,
    **changes: Any,
) -> Solution:
    """Plan one tour per agent with a policy, and improve the tours if asked to.

    The games are played by the depot rule "final", so that tours are complete whatever the policy does. Neither the
    policy nor any setting or random generator of the process is changed, and calls may run in several threads at once.

    >>> solve(instance, decode="sample", samples=128, seed=1)

    Args:
        instance: the problem.
        policy: the name of a shipped model, a file that ``dan_policy.save`` wrote, any network or any actor (see
            ``make_actor``). A file of a network of one's own is loaded first: ``load(file, network=...)``.
        options: how to plan; None: ``SolveOptions()``.
        prefixes: the beginning of each agent's tour (``mtsp_env.tours.check_prefixes``), to plan the remaining tours of
            a team that is already under way. None: all agents are at the depot.
        **changes: fields of ``SolveOptions`` that replace those of ``options``.

    Raises:
        ImportError: ``improve`` without Numba.
        OSError: no such weights.
        TypeError: an option that does not exist.
        ValueError: world fields other than ``speeds`` and ``service``, bad weights, an option outside its range, one
            that the policy does not have, or games that do not fit into the memory.
    """
    check_plannable(instance.world)
    options = replace(options or SolveOptions(), **changes)
    check_memory("n_agents", instance.n_agents, BYTES_PER_AGENT)
    begun = [] if prefixes is None else check_prefixes(instance, prefixes)
    team = instance if begun else without_spare_agents(instance)
    most_games = max(options.games, GAMES) if options.reconstruct else options.games
    check_memory("samples", most_games, BYTES_PER_GAME_AND_NODE * (instance.n_nodes + team.n_agents))
    improve = _improvement(options, begun, instance)
    device = find_device(options.device)
    named = isinstance(policy, (str, os.PathLike))  # a network that is nobody else's
    policy = _placed(_loaded(policy, device), device)
    name, own = network_name(policy), policy
    policy = _configured(own, options, instance.n_nodes)
    greedy = _configured(own, replace(options, decode="greedy", clip=None), instance.n_nodes)
    generator = torch.Generator(device).manual_seed(options.seed) if options.decode == "sample" else None

    start = time.perf_counter()
    game = rules.make_rules(instance.n_nodes, team.n_agents, SPEED, "final", "sparse", None)
    state = begin(team, game, begun, options.games, options.augment, device)
    with torch.inference_mode(named):
        with _autocast(policy, options, options.games, instance.n_nodes, device):
            tours = best_tours(play(policy, state, game, generator, _sharpness(policy, own)))
        with _autocast(policy, options, GAMES, instance.n_nodes, device):
            rng = np.random.default_rng(options.seed)
            tours = reconstruct(team, tours, greedy, SPEED, options.reconstruct, rng, begun, device)
    tours = improve(instance, tours + [[0, 0] for _ in range(instance.n_agents - team.n_agents)])
    seconds = time.perf_counter() - start

    check_tours(instance, tours)
    return Solution(tours, makespan(instance, tours), seconds, f"{name}{_decoding(options)}")


def without_spare_agents(instance: Instance) -> Instance:
    """The instance with at most one agent per city; others would never leave by the rule "final".

    All agents decide at the start, in their order, and each of them picks a city while there are any. A team whose
    agents differ in speed stays as it is.
    """
    if instance.speeds is not None:
        return instance
    return replace(instance, n_agents=min(instance.n_agents, instance.n_nodes - 1))


def _improvement(options: SolveOptions, prefixes: Tours, problem: Instance) -> Callable[[Instance, Tours], Tours]:
    """The reference solver for ``improve`` seconds, its kernels compiled; without ``improve``, nothing."""
    if options.improve is None:
        return lambda instance, tours: tours
    from mtsp_env import reference  # needs Numba

    reference.compile_kernels(worlds=problem.world != ())
    return partial(reference.improve, seconds=options.improve, seed=options.seed, prefixes=prefixes or None)


def _loaded(policy: Any, device: torch.device) -> Network | TensorDictModuleBase:
    """The policy itself, or the network behind a name or file, which is read once per process and file version."""
    if not isinstance(policy, (str, os.PathLike)):
        return policy
    file = find(policy)
    with _load_lock:
        return _read(file, file.stat().st_mtime_ns, device)


_load_lock = Lock()  # threads that start together do not all read the same file


@lru_cache(maxsize=4)
def _read(file: Path, _modified: int, device: torch.device) -> nn.Module:
    network = load(file, device)
    if device.type == "cpu":  # weights stored by columns are faster for the few rows of a single game
        for layer in network.modules():
            if isinstance(layer, nn.Linear):
                layer.weight.data = layer.weight.data.t().contiguous().t()
    return network


def _placed(policy: Any, device: torch.device) -> Any:
    """The policy on ``device`` in evaluation mode: itself if it already is, else a copy, because it is the caller's."""
    if not isinstance(policy, nn.Module):
        return policy
    tensors = [*policy.parameters(), *policy.buffers()]
    wrappers = (module for module in policy.modules() if is_actor(module) or isinstance(module, nn.ModuleList))
    networks = set(policy.modules()) - set(wrappers)  # the mode of what is around an actor's network changes nothing
    if any(tensor.device != device for tensor in tensors) or any(module.training for module in networks):
        return deepcopy(policy).to(device).eval()
    return policy


def _configured(policy: Any, options: SolveOptions, n_nodes: int) -> Any:
    """The policy, or a shallow copy of it that shares its parameters and has the configuration of ``options``."""
    config: Any = getattr(policy, "config", None)
    known = {field.name for field in fields(config)} if is_dataclass(config) else set()
    given = {name: getattr(options, name) for name in ("view", "prune_visited", "confidence")} | {
        "tanh_clip": options.clip
    }
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for name in changes.keys() - known:
        option = "clip" if name == "tanh_clip" else name
        raise ValueError(f"{option} needs a network whose config has the field {name!r}, got {network_name(policy)!r}")
    if "tanh_clip" in known and options.decode == "sample":
        changes.setdefault("tanh_clip", sampling_clip(config.tanh_clip, n_nodes, options.augment))
    prunes = changes.get("prune_visited", getattr(config, "prune_visited", True))
    if "view" in known and config.view is None and prunes:
        changes.setdefault("view", default_view(n_nodes))
    if not changes:
        return policy
    policy = copy(policy)
    policy.config = replace(config, **changes)
    return policy


def _sharpness(policy: Any, own: Any) -> float:
    """How many times as large the logits of a configured policy are as its own."""
    clip, own_clip = (getattr(getattr(network, "config", None), "tanh_clip", 1.0) for network in (policy, own))
    return 1.0 if clip == own_clip else clip / own_clip


def _autocast(policy: Any, options: SolveOptions, games: int, n_nodes: int, device: torch.device) -> torch.autocast:
    """The precision for so many games side by side, as a context.

    It caches no weights: PyTorch's cache of them is shared by all threads.
    """
    view = getattr(getattr(policy, "config", None), "view", None) or n_nodes
    use_bfloat16 = options.precision == "bfloat16"
    if options.precision == "auto" and getattr(policy, "supports_bfloat16", False):
        use_bfloat16 = bfloat16_pays(device, games * min(n_nodes, 1 + view))
    return torch.autocast(device.type, torch.bfloat16, enabled=use_bfloat16, cache_enabled=False)


def _decoding(options: SolveOptions) -> str:
    """In the paper's notation: (g.), (s.64); with "x8" if augmented."""
    decode = "g." if options.decode == "greedy" else f"s.{options.samples}"
    reconstruct = f"+reconstruct({options.reconstruct})" if options.reconstruct else ""
    improve = "" if options.improve is None else f"+improve({options.improve:g} s)"
    return f"({decode}{'x8' if options.augment else ''}){reconstruct}{improve}"

"""Episodes from Ray workers, on one machine or a cluster: each plays a part of every batch with the weights of now."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector

from dan_policy.actor import OBSERVATION, make_actor
from dan_policy.episode import Episode, rollout
from train.collect import Instances, draw, draw_size, environment, play, repeat
from train.config import ReinforceConfig


class RayWorkers:
    """TorchRL's ``Collector(backend="ray")``: a batch of whole, on-policy episodes for each optimiser step.

    All parts of a batch have the step's n and m and depend on (seed, step, worker) alone, so that a continuation plays
    the same. Workers are sent the weights before every batch, and the learner waits for all of them: no episode is of
    an older policy. Nodes and actions travel; the observations are made again here.

    Args:
        network: what the workers play, its weights as they are at each ``collect``.
        first: the step that is collected first.

    Raises:
        ModuleNotFoundError: no Ray.
        ValueError: more workers than the cluster has CPUs (or GPUs) for.
    """

    def __init__(self, network: nn.Module, config: ReinforceConfig, first: int):
        try:
            import ray
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError('--collector ray needs Ray: pip install "mtsp-env[ray]"', name="ray") from error
        self.config, self.started = config, not ray.is_initialized()
        if self.started:
            ray.init()  # a cluster where RAY_ADDRESS names one, else this machine
        needs = {"num_cpus": 1, "num_gpus": int(torch.device(config.device).type == "cuda")}
        try:
            _check_resources(config.ray_workers, needs, ray.cluster_resources())
            self.workers = Collector(
                [_placeholder] * config.ray_workers,
                make_actor(network),
                backend="ray",
                sync=True,
                frames_per_batch=config.ray_workers,  # not looked at: see _EpisodeCollector
                total_frames=sys.maxsize,
                backend_options={
                    "collector_class": _EpisodeCollector,
                    "collector_kwargs": {"config": config, "first": first, "auto_register_policy_transforms": False},
                    "remote_configs": needs,
                },
            )
        except BaseException:
            if self.started:
                ray.shutdown()
            raise
        self.batches = iter(self.workers)

    def collect(self) -> tuple[Instances, Episode]:
        """The next step's instances and the episodes played on them, worker by worker."""
        self.workers.update_policy_weights_()
        played = next(self.batches).flatten(0, 1).to(self.config.device)
        instances = Instances(played["nodes"], int(played["n_agents"][0]))
        return instances, replay(instances, played["action"], self.config)

    def close(self) -> None:
        """End the workers, and Ray where it was started here."""
        self.workers.shutdown(shutdown_ray=self.started)


def _check_resources(workers: int, needs: dict[str, int], there: dict[str, float]) -> None:
    """Ray would wait for more of them, and say nothing."""
    for need, name in (("num_cpus", "CPU"), ("num_gpus", "GPU")):
        if workers * needs[need] > there.get(name, 0):
            raise ValueError(f"ray_workers must be at most Ray's {there.get(name, 0):g} {name}s, got {workers}")


def play_part(policy: nn.Module, config: ReinforceConfig, step: int, worker: int) -> tuple[Instances, Episode]:
    """One worker's part of a step's batch: depends on ``config.seed``, ``step``, ``worker`` and the weights alone."""
    now = config.at(step)
    size = draw_size(np.random.default_rng([config.seed, step]), now)
    rng = np.random.default_rng([config.seed, step, worker + 1])
    instances = repeat(draw(rng, now, now.batch_size, now.batch_tokens, size), now.samples)
    with torch.random.fork_rng():
        torch.manual_seed(int(rng.integers(2**63)))
        return instances, play(policy, instances, now, "sample", keep=True)


def replay(instances: Instances, action: Tensor, config: ReinforceConfig) -> Episode:
    """The episodes in which the actions (B, T) were taken; what comes after an episode's end is not looked at."""
    steps = iter(action.unbind(1))
    scripted = TensorDictModule(lambda _: next(steps), ["agent"], ["action"])
    env = environment(instances.nodes.shape[1], instances.n_agents, len(action), config)
    return rollout(scripted, env, "greedy", instances.nodes, (*OBSERVATION, "action_mask"))


class _EpisodeCollector(Collector):
    """What runs in a worker: its frames are episodes, in batches of the size that the step asks for."""

    def __init__(self, *args: Any, config: ReinforceConfig, first: int, **kwargs: Any):
        self.config, self.step = config, first
        super().__init__(*args, **kwargs)

    def rollout(self) -> TensorDictBase:
        """Nodes (B, n, 2), ``n_agents`` (B,) and ``action`` (B, T), padded to the environment's bound on T."""
        instances, episode = play_part(self._orig_policy, self.config, self.step, self.worker_idx)
        self.step += 1
        nodes, taken = instances.nodes, episode.decisions["action"]  # (T, B)
        env = environment(nodes.shape[1], instances.n_agents, len(nodes), self.config)
        action = taken.new_zeros(len(nodes), env.rules.max_decisions)
        action[:, : len(taken)] = taken.T
        n_agents = torch.full((len(nodes),), instances.n_agents)
        return TensorDict({"nodes": nodes, "n_agents": n_agents, "action": action}, batch_size=[len(nodes)]).cpu()

    def __repr__(self) -> str:
        """One line: Ray puts it before everything that a worker prints."""
        return f"{type(self).__name__} {self.worker_idx}"


def _placeholder() -> Any:
    """An environment of some size: Collector wants one, and plays on that of each step."""
    return environment(3, 1, 1, ReinforceConfig())

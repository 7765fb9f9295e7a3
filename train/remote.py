"""Episodes from Ray workers, on one machine or a cluster: each plays a part of every batch with the current weights."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector

from dan_policy.actor import make_actor
from dan_policy.episode import Episode, rollout
from dan_policy.network import Key
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Problem
from train.collect import draw, draw_size, environment, play, present, repeat
from train.network import observation_keys
from train.reinforce_config import ReinforceConfig


class RayWorkers:
    """TorchRL's ``Collector(backend="ray")``, one batch of whole, on-policy episodes per optimiser step.

    All parts of a batch have the step's n and m and depend on (seed, step, worker) alone, so that a continuation plays
    the same episodes. Workers receive the weights before every batch, and the learner waits for all of them: no episode
    comes from an older policy. Only instances and actions are sent; the observations are computed again here.

    Args:
        network: the network that the workers play, with its weights at the time of each ``collect``.
        config: the run's options.
        first_step: the first step that is collected.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ValueError: the cluster has fewer CPUs (or GPUs) than workers.
    """

    def __init__(self, network: nn.Module, config: ReinforceConfig, first_step: int):
        try:
            import ray
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("--collector ray needs Ray: pip install --group ray", name="ray") from error
        self.config, self.keys, self.started = config, observation_keys(network), not ray.is_initialized()
        if self.started:
            ray.init()  # the cluster that RAY_ADDRESS names, otherwise this machine
        needs = {"num_cpus": 1, "num_gpus": int(torch.device(config.device).type == "cuda")}
        try:
            _check_resources(config.ray_workers, needs, ray.cluster_resources())
            self.workers = Collector(
                [_placeholder] * config.ray_workers,
                make_actor(network),
                backend="ray",
                sync=True,
                frames_per_batch=config.ray_workers,  # ignored, see _EpisodeCollector
                total_frames=sys.maxsize,
                backend_options={
                    "collector_class": _EpisodeCollector,
                    "collector_kwargs": {
                        "config": config,
                        "first_step": first_step,
                        "auto_register_policy_transforms": False,
                    },
                    "remote_configs": needs,
                },
            )
            # The first exchange of weights waits a minute for the workers, but importing torch may take them longer
            ray.get([worker.stats.remote() for worker in self.workers.remote_collectors])
        except BaseException:
            if self.started:
                ray.shutdown()
            raise
        self.batches = iter(self.workers)

    def collect(self) -> tuple[Problem, Episode]:
        """The next step's problem and the episodes on it, worker by worker."""
        self.workers.update_policy_weights_()
        played = next(self.batches).flatten(0, 1).to(self.config.device)
        problem = Problem(int(played["n_agents"][0]), dict(played["problem"].items()))
        return problem, replay(problem, played["action"], self.keys, self.config)

    def close(self) -> None:
        """End the workers, and Ray if it was started here."""
        self.workers.shutdown(shutdown_ray=self.started)


def _check_resources(workers: int, needs: dict[str, int], resources: dict[str, float]) -> None:
    """Refuse what Ray would wait for without a word."""
    for need, name in (("num_cpus", "CPU"), ("num_gpus", "GPU")):
        if workers * needs[need] > resources.get(name, 0):
            raise ValueError(f"ray_workers must be at most Ray's {resources.get(name, 0):g} {name}s, got {workers}")


def play_part(policy: nn.Module, config: ReinforceConfig, step: int, worker: int) -> tuple[Problem, Episode]:
    """One worker's part of a step's batch, which depends on the seed, ``step``, ``worker`` and the weights alone."""
    now = config.at(step)
    size = draw_size(np.random.default_rng([config.seed, step]), now)
    rng = np.random.default_rng([config.seed, step, worker + 1])
    problem = repeat(draw(rng, now, now.batch_size, now.batch_tokens, size), now.samples)
    with torch.random.fork_rng():
        torch.manual_seed(int(rng.integers(2**63)))
        return problem, play(policy, problem, now, "sample", keep=True)


def replay(problem: Problem, action: Tensor, keys: Sequence[Key], config: ReinforceConfig) -> Episode:
    """The episodes in which the actions (B, T) were taken, with the observation's ``keys`` in their decisions.

    Actions after an episode's end are ignored.
    """
    steps = iter(action.unbind(1))
    scripted = TensorDictModule(lambda _: next(steps), ["agent"], ["action"])
    env = environment(problem, config)
    return rollout(scripted, env, "greedy", problem, present(env, keys))


class _EpisodeCollector(Collector):
    """What runs in a worker: its frames are whole episodes, in batches of the size of the step."""

    def __init__(self, *args: Any, config: ReinforceConfig, first_step: int, **kwargs: Any):
        self.config, self.step = config, first_step
        super().__init__(*args, **kwargs)

    def rollout(self) -> TensorDictBase:
        """The ``problem``, ``n_agents`` (B,) and ``action`` (B, T), padded to the environment's bound on T."""
        problem, episode = play_part(self.policy, self.config, self.step, self.worker_idx)
        self.step += 1
        assert episode.decisions is not None  # play_part keeps them
        taken, batch = episode.decisions["action"], len(problem.nodes)  # (T, B)
        action = taken.new_zeros(batch, environment(problem, self.config).rules.max_decisions)
        action[:, : len(taken)] = taken.T
        parts = {"problem": dict(problem.arrays), "n_agents": torch.full((batch,), problem.n_agents), "action": action}
        return TensorDict(parts, batch_size=[batch]).cpu()

    def __repr__(self) -> str:
        """One line: Ray prints it before everything that a worker prints."""
        return f"{type(self).__name__} {self.worker_idx}"


def _placeholder() -> Any:
    """A small environment: Collector requires one, but episodes are played in environments of each step's size."""
    return BatchedMTSP(3, 1, 1)

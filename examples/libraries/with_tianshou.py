"""Tianshou's PPO on the Gymnasium view, with a network that masks its own logits.

Tianshou hands a dict of observations on to the network as it is, here with the keys "obs" and "mask". Its DQN applies
"mask" by itself; PPO does not, so the network must. One network decides for all agents.
"""

import time

import gymnasium
import numpy as np
import torch
from compare import GAME, arguments, compare, flat, make_env
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory, LRSchedulerFactoryLinear
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from torch import nn

args = arguments(__doc__, steps=60_000)
n_envs, steps_per_update = 8, 1024
steps = max(1, args.steps // steps_per_update) * steps_per_update


class VectorAndMask(gymnasium.ObservationWrapper):
    """The flat observation, and the mask beside it."""

    def __init__(self) -> None:
        super().__init__(make_env())
        n, m = GAME["n_nodes"], GAME["n_agents"]
        vector = gymnasium.spaces.Box(-1, 3, (3 * n + 4 * m,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(obs=vector, mask=gymnasium.spaces.MultiBinary(n))

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {"obs": flat(observation), "mask": self.unwrapped.action_masks()}


def mlp(outputs: int) -> nn.Sequential:
    size = 3 * GAME["n_nodes"] + 4 * GAME["n_agents"]
    return nn.Sequential(nn.Linear(size, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs))


class Actor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.score = mlp(GAME["n_nodes"])

    def forward(self, seen: Batch, state: None = None, info: dict | None = None) -> tuple[torch.Tensor, None]:
        mask = torch.as_tensor(np.asarray(seen.mask, bool))
        return self.score(torch.as_tensor(seen.obs)).masked_fill(~mask, -1e8), state


class Critic(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.value = mlp(1)

    def forward(self, seen: Batch, **_: object) -> torch.Tensor:
        return self.value(torch.as_tensor(seen.obs))


np.random.seed(args.seed)  # noqa: NPY002  Tianshou shuffles batches with it
torch.manual_seed(args.seed)
envs = DummyVectorEnv([VectorAndMask] * n_envs)
envs.seed(args.seed)
schedule = {"max_epochs": 1, "epoch_num_steps": steps, "collection_step_num_env_steps": steps_per_update}
ppo = PPO(
    policy=DiscreteActorPolicy(actor=Actor(), action_space=envs.action_space[0], deterministic_eval=True),
    critic=Critic(),
    optim=AdamOptimizerFactory(lr=1e-3).with_lr_scheduler_factory(LRSchedulerFactoryLinear(**schedule)),
    gamma=1.0,  # an episode's rewards add up to -makespan: all of it counts, however many decisions it takes
    max_grad_norm=0.5,
)

start = time.process_time()
ppo.run_training(
    OnPolicyTrainerParams(
        training_collector=Collector(ppo, envs, VectorReplayBuffer(steps_per_update, n_envs)),
        batch_size=256,
        update_step_num_repetitions=4,
        show_progress=False,
        verbose=False,
        **schedule,
    )
)
seconds = time.process_time() - start


@torch.no_grad()
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    seen = Batch(obs=flat(observation)[None], mask=mask[None])
    return ppo.policy(Batch(obs=seen, info={})).act.item()


compare("tianshou", greedy, steps, seconds)

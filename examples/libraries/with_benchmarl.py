"""BenchMARL's IPPO on the PettingZoo environment, in TorchRL's grouped convention.

BenchMARL's PettingZoo task takes parallel environments; the task below takes one in which agents act one at a time. All
agents are one group with one policy. At each step all of them get an action, and the environment plays only that of the
agent whose turn it is: the others' are not masked out of the loss, so two thirds of what IPPO learns from are noise.
"""

import tempfile
import time
from collections.abc import Callable
from itertools import count

import numpy as np
import torch
from benchmarl.algorithms import IppoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models import MlpConfig
from compare import GAME, arguments, compare, flat
from tensordict import TensorDict
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from mtsp_env import mtsp_v0
from mtsp_env.wrappers import flatten

args = arguments(__doc__, steps=20_000)
steps_per_update = 1024
steps = max(1, args.steps // steps_per_update) * steps_per_update
AGENTS = [f"agent_{i}" for i in range(GAME["n_agents"])]


class Task(PettingZooClass):
    """What BenchMARL asks about an environment."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: str
    ) -> Callable[[], EnvBase]:
        seeds = count(1000 * args.seed)  # each of the environments plays games of its own
        return lambda: PettingZooWrapper(
            flatten(mtsp_v0.env(**GAME)),
            use_mask=True,  # says whose turn it is, which environments with turns need
            categorical_actions=True,
            group_map={"agents": AGENTS},
            seed=next(seeds),
            device=device,
        )

    def supports_continuous_actions(self) -> bool:
        return False

    def supports_discrete_actions(self) -> bool:
        return True

    def has_state(self) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        return 20 * (GAME["n_nodes"] + GAME["n_agents"])


settings = ExperimentConfig.get_from_yaml()
settings.max_n_frames = steps
settings.gamma = 1.0  # an episode's rewards add up to -makespan: all of it counts, however many decisions it takes
settings.lr = 1e-3
settings.on_policy_collected_frames_per_batch = steps_per_update
settings.on_policy_n_envs_per_worker = 8
settings.on_policy_n_minibatch_iters = 4
settings.on_policy_minibatch_size = 256
settings.evaluation = settings.render = settings.create_json = False
settings.loggers = []
settings.save_folder = tempfile.mkdtemp()
algorithm = IppoConfig.get_from_yaml()
algorithm.entropy_coef = 0.01
network = MlpConfig(num_cells=[128, 128], activation_class=torch.nn.Tanh, layer_class=torch.nn.Linear)
experiment = Experiment(
    task=Task(name="mtsp", config={}),
    algorithm_config=algorithm,
    model_config=network,
    critic_model_config=network,
    seed=args.seed,
    config=settings,
)

start = time.process_time()
experiment.run()
seconds = time.process_time() - start


@torch.no_grad()
@set_exploration_type(ExplorationType.DETERMINISTIC)
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    """The shared policy's choice; all agents of the group are shown what the deciding one sees."""
    vectors = torch.as_tensor(flat(observation)).expand(1, len(AGENTS), -1)
    masks = torch.as_tensor(mask).expand(1, len(AGENTS), -1)
    group = TensorDict({"observation": {"observation": vectors}, "action_mask": masks}, [1, len(AGENTS)])
    return experiment.policy(TensorDict({"agents": group}, [1]))["agents", "action"][0, 0].item()


compare("benchmarl", greedy, steps, seconds)

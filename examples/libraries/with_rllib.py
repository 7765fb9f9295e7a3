"""RLlib's PPO on the PettingZoo environment: three agents that share one module.

``ActionMaskingTorchRLModule``, from RLlib's examples, wants the keys "observations" and "action_mask". RLlib pays an
agent what has accumulated since its last decision, so the reward here is sparse: every agent gets -makespan at the end.
"""

import time

import numpy as np
import ray
import torch
from compare import GAME, arguments, compare, flat
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import PettingZooEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.tune.registry import register_env

from mtsp_env import mtsp_v0
from mtsp_env.wrappers import flatten

args = arguments(__doc__, steps=20_000)
steps_per_update = 1024
updates = max(1, args.steps // steps_per_update)


def make_pettingzoo_env(_: object) -> PettingZooEnv:
    return PettingZooEnv(flatten(mtsp_v0.env(**{**GAME, "reward": "sparse"}), observation_key="observations"))


register_env("mtsp", make_pettingzoo_env)
network = {"fcnet_hiddens": [128, 128], "fcnet_activation": "tanh", "vf_share_layers": False}
module = RLModuleSpec(module_class=ActionMaskingTorchRLModule, model_config=network)
config = (
    PPOConfig()
    .environment("mtsp")
    .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **_: "shared")
    .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": module}))
    .env_runners(num_env_runners=0)  # games and learning in this process
    .training(
        gamma=1.0,  # all of the makespan counts, however many decisions it takes
        lambda_=0.95,
        lr=[[0, 1e-3], [updates * steps_per_update, 0.0]],
        train_batch_size_per_learner=steps_per_update,
        minibatch_size=256,
        num_epochs=4,
        entropy_coeff=0.01,
        vf_loss_coeff=0.5,
        grad_clip=0.5,
        use_kl_loss=False,
        clip_param=0.2,
    )
    .debugging(seed=args.seed, log_level="ERROR")
)
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
ppo = config.build_algo()

start = time.process_time()
for _ in range(updates):
    result = ppo.train()
seconds = time.process_time() - start
shared = ppo.get_module("shared")


@torch.no_grad()
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    seen = {
        "observations": torch.as_tensor(flat(observation))[None],
        "action_mask": torch.as_tensor(mask)[None].float(),
    }
    return shared.forward_inference({"obs": seen})["action_dist_inputs"].argmax().item()


compare("rllib", greedy, int(result["num_env_steps_sampled_lifetime"]), seconds)
ray.shutdown()

"""SB3-contrib's MaskablePPO on the Gymnasium view.

It finds the mask in the environment's ``action_masks()``. "MultiInputPolicy" takes the dict of observations as it is.
One network decides for all agents.
"""

import time

import numpy as np
from compare import arguments, compare, make_env
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env

args = arguments(__doc__, steps=60_000)
model = MaskablePPO(
    "MultiInputPolicy",
    make_vec_env(make_env, n_envs=8),  # one after the other in this process
    gamma=1.0,  # an episode's rewards add up to -makespan: all of it counts, however many decisions it takes
    n_steps=128,
    batch_size=256,
    n_epochs=4,
    learning_rate=lambda left: 1e-3 * left,  # from 1e-3 to 0
    ent_coef=0.01,
    policy_kwargs={"net_arch": [128, 128]},
    seed=args.seed,
    device="cpu",
)

start = time.process_time()
model.learn(total_timesteps=args.steps)
seconds = time.process_time() - start


def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    action, _ = model.predict(observation, action_masks=mask, deterministic=True)
    return action.item()


compare("sb3", greedy, model.num_timesteps, seconds)

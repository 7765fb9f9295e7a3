"""AgileRL's PPO on the Gymnasium view, with flat observations.

Its rollouts take the mask from ``info["action_mask"]``, and it learns from the masked probabilities. One network
decides for all agents. AgileRL's evolution of networks and settings is left out: this is one learner.
"""

import time

import gymnasium
import numpy as np
import torch
from agilerl.algorithms import PPO
from agilerl.rollouts import collect_rollouts
from compare import arguments, compare, flat, make_env

args = arguments(__doc__, steps=60_000)
n_envs, steps_per_update = 8, 1024
updates = max(1, args.steps // steps_per_update)

np.random.seed(args.seed)  # noqa: NPY002  AgileRL shuffles batches with it
torch.manual_seed(args.seed)
envs = gymnasium.vector.SyncVectorEnv(
    [lambda: gymnasium.wrappers.FlattenObservation(make_env())] * n_envs,
    autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,  # a step that ends a game returns the start of the next
)
ppo = PPO(
    envs.single_observation_space,
    envs.single_action_space,
    num_envs=n_envs,
    learn_step=steps_per_update,
    batch_size=256,
    update_epochs=4,
    lr=1e-3,
    gamma=1.0,  # an episode's rewards add up to -makespan: all of it counts, however many decisions it takes
    net_config={"encoder_config": {"hidden_size": [128]}, "head_config": {"hidden_size": [128]}},
    share_encoders=False,
)

start = time.process_time()
seen, info = envs.reset(seed=args.seed)
done, scores = np.zeros(n_envs), np.zeros(n_envs)
for _ in range(updates):
    _, seen, done, scores, info = collect_rollouts(
        ppo, envs, last_obs=seen, last_done=done, last_scores=scores, last_info=info
    )
    ppo.learn()
seconds = time.process_time() - start
nodes = torch.arange(envs.single_action_space.n)


@torch.no_grad()
def greedy(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    seen = torch.as_tensor(flat(observation)).expand(len(nodes), -1)  # the same for every node that may be next
    log_probs, _, _ = ppo.evaluate_actions(seen, nodes, action_mask=np.tile(mask, (len(nodes), 1)))
    return log_probs.masked_fill(~torch.as_tensor(mask), -torch.inf).argmax().item()


compare("agilerl", greedy, updates * steps_per_update, seconds)

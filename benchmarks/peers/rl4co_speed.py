"""Measure the speed of RL4CO's MTSPEnv and print it as JSON.

Run it with the Python of an environment that has RL4CO (README.md); it imports nothing from this project.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from importlib.metadata import version

import torch
from rl4co.envs import MTSPEnv
from tensordict import TensorDict


def draw(td: TensorDict) -> torch.Tensor:
    """Uniformly random legal actions (B,), as RL4CO's ``random_policy`` draws them."""
    return torch.multinomial(td["action_mask"].float(), 1).squeeze(-1)


def env_seconds(env: MTSPEnv, batch: int) -> list[float]:
    """Seconds of each ``env.step`` of a random episode, without drawing the actions."""
    td, seconds = env.reset(batch_size=[batch]), []
    while not td["done"].all():
        td.set("action", draw(td))
        start = time.perf_counter()
        td = env.step(td)["next"]
        seconds.append(time.perf_counter() - start)
    return seconds


def loop_seconds(env: MTSPEnv, batch: int) -> tuple[list[float], int]:
    """Seconds of each pass of the loop of a random episode, drawing included, and the number of decisions.

    Finished rows are stepped along with the others; these further steps do not count as decisions.
    """
    td, done, times = env.reset(batch_size=[batch]), [], [time.perf_counter()]
    while not td["done"].all():
        td.set("action", draw(td))
        td = env.step(td)["next"]
        done.append(td["done"])
        times.append(time.perf_counter())
    decisions = int((~torch.stack(done)).sum()) + batch
    return [end - start for start, end in itertools.pairwise(times)], decisions


def main() -> None:
    """Print package versions and measurements: a list for each episode, with a value for each of its steps."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=50, help="number of nodes with the depot (RL4CO's num_loc)")
    parser.add_argument("--agents", type=int, default=5, help="number of agents")
    parser.add_argument("--batch", type=int, default=64, help="number of instances")
    parser.add_argument("--threads", type=int, default=1, help="number of torch's threads")
    parser.add_argument("--seconds", type=float, default=3.0, help="seconds of measuring")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    agents = {"min_num_agents": arguments.agents, "max_num_agents": arguments.agents}
    env = MTSPEnv(generator_params={"num_loc": arguments.nodes, **agents}, seed=0)
    env_seconds(env, arguments.batch)  # warms up
    loop_seconds(env, arguments.batch)
    env_times, loops, start = [], [], time.perf_counter()
    while not env_times or time.perf_counter() - start < arguments.seconds:
        env_times.append(env_seconds(env, arguments.batch))
        loops.append(loop_seconds(env, arguments.batch))
    report = {
        "versions": {name: version(name) for name in ("rl4co", "torch", "torchrl", "tensordict")},
        "env": env_times,
        "loop": [seconds for seconds, _ in loops],
        "decisions": [decisions for _, decisions in loops],
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()

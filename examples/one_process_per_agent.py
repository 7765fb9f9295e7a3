"""One process for each agent: they know of each other only what they hear over sockets, and one of them is killed.

    python examples/one_process_per_agent.py --policy default --kill 1 0.8

Each agent has a process of its own with its own copy of the policy, and a belief about the game. It hears from the
others when they set off (for which node, when, and how long it will take), and notices by itself that one of them is
gone: its connection to it breaks. ZeroMQ carries the messages; each process has one socket at which it is called.

The process that starts them plays the world. Its environment says when an agent arrives, when cities appear and who
breaks down, and judges the game. It tells an agent that it has arrived, and everybody the time and which cities have
appeared, but nothing about other agents. To break an agent down it kills its process (SIGKILL). The clock stands still
until everybody has heard what was said: messages take milliseconds, ticks are far longer.

What an agent observes from its belief is, bit for bit, what the environment would show it. It needs pyzmq.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import zmq
from zmq.utils.monitor import recv_monitor_message

from mtsp_env import Instance, check_log, mtsp_v0
from mtsp_env.distributions import arrivals, sample, service, team
from mtsp_env.rules import TICK_TOLERANCE, travel_ticks

Policy = Callable[[dict[str, np.ndarray]], int]  # an observation, with its action mask -> the next node
Decision = tuple[int, int, int]  # tick, agent, node

WORLD = -1  # the sender of the world's messages
PATIENCE = 120_000  # ms that a process waits for a message before it gives up


def world_of_arrivals(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Cities appear, agents differ in speed, visits take time, and some agents may break down."""
    fields: dict[str, np.ndarray] = {"breaks": np.full((batch, n_agents), np.inf)}
    for scenario in (arrivals, team, service):
        fields |= scenario(rng, batch, n_nodes, n_agents)
    return fields


# What one agent believes


class Belief:
    """What ``agent`` has heard of a game, and what it observes because of it.

    Args:
        agent: its index.
        depot: the depot's coordinates.
        speeds: (m,) every agent's speed, which all of them say in advance.
        n_nodes: how many nodes there will be; their places are unknown until they appear.
        speed: distance per tick.
    """

    def __init__(self, agent: int, depot: Sequence[float], speeds: Sequence[float], n_nodes: int, speed: float):
        m = len(speeds)
        self.agent, self.speed, self.now = agent, speed, 0
        self.nodes = np.tile(np.array(depot), (n_nodes, 1))  # an unknown city looks as if it lay on the depot
        self.service = np.zeros(n_nodes)
        self.known = np.arange(n_nodes) == 0
        self.visited = np.zeros(n_nodes, bool)
        self.speeds, self.alive = np.array(speeds), np.ones(m, bool)
        self.destination, self.leg = np.zeros(m, int), np.zeros(m)  # leg: its announced time
        self.departed, self.arrives, self.ready = np.zeros((3, m), int)  # ticks

    def set_off(self, node: int) -> dict[str, Any]:
        """What this agent tells everybody, itself included, as it sets off for ``node``."""
        x, y = self.nodes[node] - self.nodes[self.destination[self.agent]]
        travel = np.sqrt(x * x + y * y) / self.speeds[self.agent]
        leg = travel + self.service[node]
        arrives, ready = (self.now + travel_ticks(np.array([travel, leg]), self.speed)).tolist()
        return {
            "agent": self.agent,
            "node": node,
            "leg": float(leg),
            "departed": self.now,
            "arrives": arrives,
            "ready": ready,
        }

    def hear_of(self, agent: int, node: int, leg: float, departed: int, arrives: int, ready: int) -> None:
        """``agent`` has set off for ``node``."""
        self.visited[node] |= node != 0
        self.destination[agent], self.leg[agent] = node, leg
        self.departed[agent], self.arrives[agent], self.ready[agent] = departed, arrives, ready

    def learn_of(self, city: int, place: Sequence[float], service: float) -> None:
        """``city`` has appeared."""
        self.nodes[city], self.service[city], self.known[city] = place, service, True

    def miss(self, agent: int) -> None:
        """``agent`` is silent from now on: the city for which it was bound, if it has not arrived, is open again."""
        self.alive[agent], self.leg[agent] = False, 0.0
        if self.arrives[agent] > self.now:
            self.visited[self.destination[agent]] = False

    def observe(self) -> dict[str, np.ndarray]:
        """Its observation and action mask, with the keys of ``mtsp_env.rules.Observation``, as it decides."""
        seen = self.nodes.astype(np.float32)
        cities = seen - seen[self.destination[self.agent]]
        a_tick_further = np.arange(len(self.alive)) < self.agent  # as Algorithm 1 has it
        elapsed = (self.now + a_tick_further - self.departed).astype(float) + TICK_TOLERANCE
        remaining = np.maximum(self.leg - self.speed * elapsed, 0.0)
        remaining[self.agent] = 0.0
        mask = self.known & ~self.visited
        away = (self.destination != 0) | ((self.leg > 0) & (self.ready > self.now))
        mask[0] = (away & self.alive).any() or not mask[1:].any()
        return {
            "cities": cities,
            "agents": np.column_stack([cities[self.destination], remaining]).astype(np.float32),
            "visited": self.visited | ~self.known,
            "action_mask": mask,
            "agent": np.int64(self.agent),
            "agent_speeds": self.speeds.astype(np.float32),
            "agent_alive": self.alive.copy(),
            "service": self.service.astype(np.float32),
            "city_known": self.known.copy(),
        }


def nearest(seen: dict[str, np.ndarray]) -> int:
    """The nearest legal city, or the depot if there is none."""
    distance = np.where(seen["action_mask"], np.hypot(*seen["cities"].T), np.inf)
    distance[0] = 1e9
    return int(np.argmin(distance))


def make_policy(name: str) -> Policy:
    """``nearest``, or the likeliest action of a shipped model or file of weights."""
    if name == "nearest":
        return nearest
    import torch

    from dan_policy import load
    from dan_policy.network import network_keys

    torch.set_num_threads(1)
    network = load(name)

    @torch.no_grad()
    def likeliest(seen: dict[str, np.ndarray]) -> int:
        values = (seen.get(key) for key in network_keys(network))  # None: what this world does not have
        logits = network(*(None if value is None else torch.as_tensor(value)[None] for value in values))[0]
        return int(logits.masked_fill(~torch.as_tensor(seen["action_mask"]), -torch.inf).argmax())

    return likeliest


# One agent's process


def run_agent(agent: int, world: str, policy: str) -> None:
    """Play one agent until the world says that the game is over, or this process is killed."""
    choose = make_policy(policy)
    context = zmq.Context()
    mailbox = context.socket(zmq.PULL)
    port = mailbox.bind_to_random_port("tcp://127.0.0.1")
    to_world = _call(context, world)
    to_world.send_json({"from": agent, "address": f"tcp://127.0.0.1:{port}"})
    start = _receive(mailbox)
    belief = Belief(agent, **start["belief"])
    others = {j: _call(context, address) for j, address in enumerate(start["addresses"]) if j != agent}
    broken_lines = {j: socket.get_monitor_socket(zmq.EVENT_DISCONNECTED) for j, socket in others.items()}
    poller = zmq.Poller()
    for socket in (mailbox, *broken_lines.values()):
        poller.register(socket, zmq.POLLIN)
    to_world.send_json({"from": agent, "heard": "start"})

    while True:
        ready = dict(poller.poll(PATIENCE))
        if not ready:
            raise TimeoutError(f"agent {agent} has heard nothing for {PATIENCE / 1000:g} s")
        for j, line in list(broken_lines.items()):
            if line in ready:
                recv_monitor_message(line)
                poller.unregister(line)
                del broken_lines[j]
                belief.miss(j)
                to_world.send_json({"from": agent, "heard": f"the silence of {j}"})
        if mailbox not in ready:
            continue
        message = mailbox.recv_json()
        if message == {"over": True}:
            context.destroy(linger=0)
            return
        if "turn" in message:
            message = {"departure": belief.set_off(choose(belief.observe()))}
            for socket in others.values():
                socket.send_json(message)
        if "departure" in message:
            belief.hear_of(**message["departure"])
            to_world.send_json({"from": agent, "heard": "departure", **message["departure"]})
            continue
        belief.now = message["now"]
        for city in message["cities"]:
            belief.learn_of(**city)
        to_world.send_json({"from": agent, "heard": "time"})


def _call(context: zmq.Context, address: str) -> zmq.Socket:
    socket = context.socket(zmq.PUSH)
    socket.setsockopt(zmq.HEARTBEAT_IVL, 1000)  # ms; notices also a line that breaks without a word
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 60_000)
    socket.connect(address)
    return socket


def _receive(mailbox: zmq.Socket) -> dict[str, Any]:
    if not mailbox.poll(PATIENCE):
        raise TimeoutError(f"no message for {PATIENCE / 1000:g} s")
    return mailbox.recv_json()


# The world


def play(instance: Instance, policy: str = "nearest", speed: float = 0.01) -> tuple[list[Decision], Any]:
    """Play an instance with a process for each agent; returns the decisions, and the environment at the end.

    Args:
        instance: an instance with the world fields of ``world_of_arrivals``. The process of an agent that breaks down
            is killed.
        policy: as for ``make_policy``.
        speed: distance per tick.
    """
    env = mtsp_v0.raw_env(
        instance.n_nodes, instance.n_agents, scenario=world_of_arrivals, depot="wait", speed=speed
    )  # fmt: skip
    env.reset(options={"instance": instance})
    context, spawn = zmq.Context(), multiprocessing.get_context("spawn")
    mailbox = context.socket(zmq.PULL)
    address = f"tcp://127.0.0.1:{mailbox.bind_to_random_port('tcp://127.0.0.1')}"
    processes = [spawn.Process(target=run_agent, args=(a, address, policy)) for a in range(instance.n_agents)]
    try:
        for process in processes:
            process.start()
        return _conduct(env, context, mailbox, processes), env
    finally:
        for process in processes:
            if process.pid is not None:
                process.kill()
                process.join()
        context.destroy(linger=0)


def _conduct(env: mtsp_v0.raw_env, context: zmq.Context, mailbox: zmq.Socket, processes: list) -> list[Decision]:
    instance, living = env.instance, set(range(env.n_agents))
    addresses = {hello["from"]: hello["address"] for hello in (_receive(mailbox) for _ in processes)}
    agents = {a: context.socket(zmq.PUSH) for a in sorted(living)}

    def tell(message: dict[str, Any], *some: int) -> None:
        for a in some or sorted(living):
            agents[a].send_json(message)

    def until_heard(what: str) -> dict[str, Any]:
        """Wait until all living agents have heard it; returns what one of them said."""
        waiting = set(living)
        while waiting:
            answer = _receive(mailbox)
            assert answer["heard"] == what, f"expected {what}, got {answer}"
            waiting.remove(answer["from"])
        return answer

    belief = {
        "depot": instance.nodes[0].tolist(),
        "speeds": instance.speeds.tolist(),
        "n_nodes": env.n_nodes,
        "speed": env.rules.speed,
    }
    for a, socket in agents.items():
        socket.connect(addresses[a])
    tell({"addresses": [addresses[a] for a in range(env.n_agents)], "belief": belief})
    until_heard("start")

    decisions: list[Decision] = []
    untold = set(range(1, env.n_nodes))
    while not (any(env.terminations.values()) or any(env.truncations.values())):
        for a in sorted(living - set(np.flatnonzero(env.game.alive[0])), key=lambda a: env.game.break_tick[0, a]):
            tell({"now": int(env.game.break_tick[0, a]), "cities": []})
            until_heard("time")
            living.remove(a)
            processes[a].kill()
            until_heard(f"the silence of {a}")
        agent = env.possible_agents.index(env.agent_selection)
        new = [city for city in sorted(untold) if env.game.appear_tick[0, city] <= env.now]
        untold -= set(new)
        cities = [{"city": c, "place": instance.nodes[c].tolist(), "service": float(instance.service[c])} for c in new]
        tell({"now": env.now, "cities": cities})
        until_heard("time")
        tell({"turn": True}, agent)
        node = until_heard("departure")["node"]
        decisions.append((env.now, agent, node))
        env.step(node)
    tell({"over": True})
    return decisions


def main() -> None:
    """Play one game, and print who went where."""
    parser = argparse.ArgumentParser(description="One process for each agent, and one of them may be killed.")
    parser.add_argument("--n-nodes", type=int, default=20, help="number of nodes, the depot included")
    parser.add_argument("--n-agents", type=int, default=3)
    parser.add_argument("--policy", default="nearest", help="nearest, or a shipped model such as default")
    parser.add_argument("--seed", type=int, default=0, help="of the instance")
    parser.add_argument("--kill", nargs=2, metavar=("AGENT", "TIME"), help="kill an agent's process at this time")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    drawn = sample("uniform", rng, 1, options.n_nodes, options.n_agents, world_of_arrivals)
    instance = drawn.instance(0)
    if options.kill:
        agent, time = int(options.kill[0]), float(options.kill[1])
        breaks = np.where(np.arange(options.n_agents) == agent, time, np.inf)
        instance = Instance(n_agents=options.n_agents, **{**instance.arrays(), "breaks": breaks})
    decisions, env = play(instance, options.policy)
    for a, tour in enumerate(env.tours):
        print(f"agent {a}: {' '.join(map(str, tour))}{'' if env.game.alive[0, a] else '  (killed)'}")
    print(f"{len(decisions)} decisions, makespan {check_log(env.instance, env.log, env.rules.speed):.3f}")


if __name__ == "__main__":
    main()

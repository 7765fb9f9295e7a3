"""What each part of DAN and of its training is worth: variants trained for the same time, judged on one set."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import sem
from torch import nn

from benchmarks import best
from benchmarks.files import replace_text
from benchmarks.run import describe_machine
from benchmarks.suite import SEED, Cell
from dan_policy import DANConfig, make_actor
from dan_policy.episode import Decode, rollout
from dan_policy.planning import SPEED
from mtsp_env.batched import BatchedMTSP
from mtsp_env.tours import makespan
from train.config import ImitateConfig
from train.imitate import Imitator, imitate
from train.presets import REFINE
from train.reinforce import reinforce

REPORT = Path(__file__).parent / "results" / "ablations.md"
CELLS = (Cell(50, 5, 20), Cell(50, 10, 20), Cell(100, 10, 20))  # those of Table 1
SAMPLES = 64
SIZES = {"n_nodes": (20, 50), "n_agents": (2, 10), "nodes_per_agent": 5}  # of what is trained on
TRIAL = 20.0  # seconds to find out how many steps of imitation the time is enough for


@dataclass(frozen=True)
class Variant:
    """A network, and how its time is spent.

    Attributes:
        warm: share of the time for imitation; the rest is REINFORCE with a baseline that samples share.
        network: what differs from the shipped configuration.
        policy: a network that is no DAN, as of ``RunConfig.policy``.
    """

    name: str
    warm: float = 0.7
    network: dict[str, Any] = field(default_factory=dict)
    policy: str | None = None


VARIANTS = (
    Variant("as shipped: imitation, then REINFORCE"),
    Variant("imitation alone", warm=1.0),
    Variant("REINFORCE alone", warm=0.0),
    Variant("visited cities not pruned", network={"prune_visited": False}),
    Variant("one layer in the city encoder", network={"city_layers": 1}),
    Variant("no agent encoder", network={"agent_layers": 0}),
    Variant("no city-agent encoder", network={"city_agent_layers": 0}),
    Variant("neither of both", network={"agent_layers": 0, "city_agent_layers": 0}),
    Variant("attention model (Kool et al. 2019)", policy="benchmarks.policies.attention_model:AttentionModel"),
)


def main(minutes: float = 15.0, folder: Path = Path("runs/ablations"), seed: int = 0, out: Path = REPORT) -> None:
    """Train and judge every variant that ``folder`` has no verdict of, one after the other; write the table.

    Args:
        minutes: of one thread for each variant, labels included.
        folder: of the runs.
        seed: of the training. The instances that variants are judged on are never trained on.
        out: file for the table in Markdown.

    Raises:
        ValueError: no time, or verdicts in ``folder`` on runs of another length or seed.
    """
    if not minutes > 0:
        raise ValueError(f"minutes must be above 0, got {minutes!r}")
    told = {"minutes": minutes, "seed": seed}
    verdicts = []
    for number, variant in enumerate(VARIANTS):
        kept = folder / f"{number}.json"
        if not kept.exists():
            print(f"{variant.name}: {minutes:g} minutes", flush=True)
            spawn = multiprocessing.get_context("spawn")  # a process for each: what one leaves in memory slows no other
            with ProcessPoolExecutor(1, spawn) as pool:
                found = pool.submit(train_and_judge, variant, 60 * minutes, seed, folder / str(number)).result()
            replace_text(kept, json.dumps(told | asdict(variant) | found))
        verdict = json.loads(kept.read_text(encoding="utf-8"))
        if {key: verdict[key] for key in told} != told or verdict["name"] != variant.name:
            raise ValueError(f"{kept} is of another run: {verdict['name']!r}, {verdict['minutes']:g} minutes")
        verdicts.append(verdict)
    table = markdown(verdicts)
    print(table)
    replace_text(out, f"# Ablations\n\n{_head(minutes, seed)}\n\n{table}\n")


def train_and_judge(variant: Variant, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """Steps of both stages, seconds, number of weights, and for each cell the gaps of greedy and sampled games."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    common = {
        "seed": seed,
        "threads": 1,
        "network": DANConfig(**{"prune_visited": True} | variant.network),
        "policy": variant.policy,
        "validation_instances": 64,
        "tensorboard": False,
        "resume": False,
    } | SIZES
    stem, taught, refined, spent = f"{time.time_ns()}", 0, 0, 0.0  # a run that was broken off is left alone
    init = None
    if variant.warm > 0:
        config = ImitateConfig(out=folder / f"{stem}-taught", steps=10**9, workers=0, **common)
        steps = max(1, int(variant.warm * seconds / pace(config)))
        run = imitate(replace(config, steps=steps, validate_every=steps, warmup=max(1, min(200, steps // 5))))
        taught, spent, init = run.step, run.seconds, str(run.config.out / "last.safetensors")
    if variant.warm < 1:
        config = replace(REFINE, out=folder / f"{stem}-refined", steps=10**9, init=init, **common)
        run = reinforce(replace(config, seconds=(1 - variant.warm) * seconds))
        refined, spent = run.step, spent + run.seconds
    network = run.policy().eval()
    return {
        "imitation_steps": taught,
        "reinforce_steps": refined,
        "seconds": spent,
        "weights": sum(p.numel() for p in network.parameters()),
        "gaps": {cell.label: {d: gaps(network, cell, d) for d in ("greedy", "sample")} for cell in CELLS},
    }


def pace(config: ImitateConfig) -> float:
    """Seconds for a step of imitation, labels included, on a run that is thrown away."""
    learner = Imitator(config)
    learner.train_step()
    start, steps = time.perf_counter(), 0
    while time.perf_counter() - start < TRIAL:
        learner.train_step()
        steps += 1
    learner.close()
    return (time.perf_counter() - start) / steps


def gaps(network: nn.Module, cell: Cell, decode: Decode) -> list[float]:
    """Of each instance, greedy or the best of the samples: makespan over that of the best known tours, minus 1."""
    instances, known = cell.instances(SEED), best.read(cell, SEED)
    rows = SAMPLES if decode == "sample" else 1
    actor = make_actor(network)
    env = BatchedMTSP(cell.n_nodes, cell.n_agents, [rows], SPEED, depot="final", check_actions=False)
    torch.manual_seed(SEED)
    found = []
    for i, instance in enumerate(instances):
        nodes = torch.as_tensor(instance.nodes.copy()).expand(rows, -1, -1)
        cost = float(env.makespan(rollout(actor, env, decode, nodes).last).min())
        found.append(cost / makespan(instance, known[i]) - 1)
    return found


def markdown(verdicts: list[dict[str, Any]]) -> str:
    """A row for each variant."""
    decodes = {"greedy": "g.", "sample": f"s.{SAMPLES}"}
    heads = [f"{cell.heading}, {short}" for cell in CELLS for short in decodes.values()]

    def rows() -> Iterator[list[str]]:
        yield ["gap to best known, %", *heads, "minutes", "steps of imitation", "of REINFORCE", "weights"]
        yield ["---"] * (len(heads) + 5)
        for verdict in verdicts:
            each = [np.array(verdict["gaps"][cell.label][d]) * 100 for cell in CELLS for d in decodes]
            yield [
                verdict["name"],
                *(f"{gap.mean():.1f} ± {sem(gap):.1f}" for gap in each),
                f"{verdict['seconds'] / 60:.1f}",
                f"{verdict['imitation_steps']:,}",
                f"{verdict['reinforce_steps']:,}",
                f"{verdict['weights']:,}",
            ]

    return "\n".join(f"| {' | '.join(row)} |" for row in rows())


def _head(minutes: float, seed: int) -> str:
    machine = describe_machine()
    return (
        f"Each variant was trained for {minutes:g} minutes of one thread ({machine['processor']}), labels included, on "
        f"n in {list(SIZES['n_nodes'])}, m in {list(SIZES['n_agents'])}, seed {seed}: 70 % of the time imitation, 30 % "
        f"REINFORCE, where nothing else is said. Mean gap to the best known tours of Table 1's 20 instances in each "
        f"column (n, m), ± standard error; one training run of each, so small differences may be chance. "
        f"The steps of imitation are set by a trial's pace, and minutes are what came of that. "
        f"Made by `python -m benchmarks ablations --minutes {minutes:g}`."
    )

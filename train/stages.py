"""The command that trains a recipe: stage after stage, resumable at any moment, with a log for the model card."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro
from pydantic import TypeAdapter, ValidationError

from dan_policy.registry import find
from mtsp_env.checks import check_seconds
from mtsp_env.files import atomic_write, write_json
from train import checkpoint
from train.average import average
from train.config import RunConfig
from train.learner import Learner, checkpoint_path
from train.loop import run, run_folder, sole_writer
from train.recipe import COMMANDS, PREVIOUS, Stage, read_recipe
from train.supervised_config import ImitateConfig

LOG = "log.json"
BEST, MIXED = "best.safetensors", "mixed.safetensors"  # in a stage's folder
GIVEN = "init.safetensors"  # the copy of the weights that --init names


@dataclass
class Record:
    """What the log says about a stage. None: not known yet."""

    name: str
    command: str
    status: Literal["waiting", "skipped", "under way", "complete"] = "waiting"
    hours: float = 0.0  # of training and validation
    steps: int = 0
    instances: int = 0
    validation_cost: float | None = None  # of the last weights, once the stage is complete
    best_validation_cost: float | None = None  # of its best weights, before a share of them is taken
    weights: str | None = None  # file that the next stage starts from, relative to the log, once the stage is complete


@dataclass
class Log:
    """The state of a run of a recipe, which is written to a JSON file after every change."""

    recipe: str
    from_stage: str | None  # the stage that starts from the weights that were given with --init
    stages: list[Record]


def recipe(
    file: tyro.conf.Positional[Path],
    out: Path,
    resume: bool = False,
    init: str | None = None,
    from_stage: str | None = None,
    seconds: float | None = None,
    device: str | None = None,
    threads: int | None = None,
) -> Log:
    """Train all stages of a recipe, one after the other, such as those of `train/recipes/default.toml`.

    It ends after the last stage, after `seconds`, or on Ctrl-C, and saves in any case. `--resume` continues a stage
    that was under way from its checkpoint. `log.json` in `out` holds each stage's hours, instances and validation cost.

    Args:
        file: the recipe.
        out: folder for the log and for a folder of each stage.
        resume: continue what `out` holds.
        init: weights to start from, a file or a shipped model's name, if no checkpoint is at hand. The stage that
            `from-stage` names starts from them with a fresh optimiser, its warm-up and its whole budget.
        from_stage: the first stage to train; the stages before it are skipped.
        seconds: stop and save after this many seconds, whatever stage is under way.
        device: replaces the recipe's.
        threads: replaces the recipe's.

    Raises:
        FileExistsError: ``out`` holds another run and ``resume`` is not set.
        ModuleNotFoundError: Numba, which `imitate` needs, is not installed.
        OSError: there is no run to resume, or no such weights.
        ValueError: the recipe or an argument does not fit, the run to resume had another configuration or its files are
            damaged, or another process trains in ``out``.
    """
    end = math.inf if seconds is None else time.monotonic() + seconds
    stages = read_recipe(file)
    _check_arguments(stages, resume, init, from_stage, seconds)
    _check_requirements(stages)
    if resume and not (out / LOG).is_file():
        raise FileNotFoundError(f"no run to resume at {out / LOG}")
    given = None if init is None else find(init).read_bytes()
    with sole_writer(out):
        log = _read_log(out, stages) if resume else _begin(file, stages, out, given, from_stage)
        weights = out / GIVEN  # what the next stage starts from
        for stage, record in zip(stages, log.stages, strict=True):
            if record.status in ("waiting", "under way"):
                left = end - time.monotonic()
                if left <= 0:
                    break
                config = _located(stage, out, weights, log.from_stage, device, threads)
                _train(stage, config, record, left, lambda: _write_log(out, log))
                if record.status != "complete":
                    break
            if record.weights is not None:
                weights = out / record.weights
    return log


def _check_arguments(
    stages: Sequence[Stage], resume: bool, init: str | None, from_stage: str | None, seconds: float | None
) -> None:
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("a recipe is trained by one process, but torchrun has started several")
    if seconds is not None:
        check_seconds("seconds", seconds)
    if (init is None) != (from_stage is None):
        raise ValueError(f"init and from_stage go together, got init={init!r} and from_stage={from_stage!r}")
    if resume and init is not None:
        raise ValueError(f"init must be None with resume, which continues from checkpoints, got {init!r}")
    names = [stage.name for stage in stages]
    if from_stage is not None and from_stage not in names:
        raise ValueError(f"from_stage must be one of {names}, got {from_stage!r}")


def _check_requirements(stages: Sequence[Stage]) -> None:
    """Fail now, not after hours, if a stage needs weights or packages that are not there."""
    for stage in stages:
        for weights in (stage.config.init, getattr(stage.config, "roll_in", None)):
            if weights not in (None, PREVIOUS):
                find(weights)
        if isinstance(stage.config, ImitateConfig):
            import mtsp_env.reference  # noqa: F401 (the teacher needs Numba)


def _begin(file: Path, stages: Sequence[Stage], out: Path, given: bytes | None, from_stage: str | None) -> Log:
    """A new run in ``out``; ``given``: the weights that ``from_stage`` starts from."""
    if (out / LOG).exists():
        raise FileExistsError(f"{out} holds a run already: add --resume to continue it, or choose another --out")
    log = Log(str(file), from_stage, [Record(stage.name, stage.command) for stage in stages])
    if given is not None:
        with atomic_write(out / GIVEN) as temporary:
            temporary.write_bytes(given)
        for record in log.stages:
            if record.name == from_stage:
                break
            record.status = "skipped"
    _write_log(out, log)
    return log


def _read_log(out: Path, stages: Sequence[Stage]) -> Log:
    """The log of the run in ``out``."""
    path = out / LOG
    try:
        log = TypeAdapter(Log).validate_json(path.read_bytes(), extra="forbid")
    except ValidationError as error:
        raise ValueError(f"{path}: not a log of a recipe, or a damaged one ({error.errors()[0]['msg']})") from error
    old, new = ([(stage.name, stage.command) for stage in part] for part in (log.stages, stages))
    if old != new:
        raise ValueError(f"a resumed run keeps its stages: {path} has {old}, the recipe {new}")
    return log


def _write_log(out: Path, log: Log) -> None:
    write_json(out / LOG, asdict(log))


def _located(
    stage: Stage, out: Path, weights: Path, from_stage: str | None, device: str | None, threads: int | None
) -> RunConfig:
    """A stage's configuration with its folder, the weights it starts from, and what the command line replaces."""
    changes: dict[str, Any] = {"out": out / stage.name}
    if stage.name == from_stage or stage.config.init == PREVIOUS:
        changes["init"] = str(weights)
    if getattr(stage.config, "roll_in", None) == PREVIOUS:
        changes["roll_in"] = str(weights)
    if device is not None:
        changes["device"] = device
    if threads is not None:
        changes["threads"] = threads
    return replace(stage.config, **changes)


def _train(stage: Stage, config: RunConfig, record: Record, left: float, write_log: Callable[[], None]) -> None:
    """Train one stage from its beginning or its checkpoint for at most ``left`` seconds, and record how it goes."""
    budget = config.seconds or math.inf
    resume = checkpoint_path(config).exists()
    spent = checkpoint.seconds(checkpoint_path(config)) if resume else 0.0
    seconds = min(left, max(budget - spent, 0.0))
    config = replace(config, resume=resume, seconds=seconds if 0 < seconds < math.inf else None)
    print(f"stage {stage.name}: {'continues' if resume else f'starts from {config.init}'}", file=sys.stderr, flush=True)
    with run_folder(config):
        learner = COMMANDS[stage.command].learner(config)
        record.status = "under way"
        write_log()
        try:
            if spent < budget:
                run(learner)
            else:  # it was stopped after its last step, before it was recorded as complete
                with closing(learner):
                    learner.restore()
            if learner.step >= config.steps or learner.seconds >= budget:
                record.validation_cost = learner.validate()  # the last weights may be the best
                learner.save()
                record.status, record.weights = "complete", f"{stage.name}/{_final_weights(stage, config)}"
        finally:  # also if a signal ends the process, which `run` lets pass once everything is saved
            _update(record, learner)
            write_log()
    print(f"stage {stage.name}: {_summary(record)}", file=sys.stderr, flush=True)


def _final_weights(stage: Stage, config: RunConfig) -> str:
    """The file in the stage's folder with what it ends with, written here if that is a share of its best weights."""
    if stage.share == 1.0 or config.init is None:
        return BEST
    network = config.policy if ":" in config.policy else None
    average((str(config.out / BEST), config.init), config.out / MIXED, (stage.share, 1.0 - stage.share), network)
    return MIXED


def _update(record: Record, learner: Learner) -> None:
    record.hours = learner.seconds / 3600
    record.steps, record.instances = learner.step, learner.instances
    record.best_validation_cost = learner.best if math.isfinite(learner.best) else None


def _summary(record: Record) -> str:
    best = "none yet" if record.best_validation_cost is None else f"{record.best_validation_cost:.4f}"
    return (
        f"{record.status}, {record.hours:.2f} h, {record.steps} steps, {record.instances} instances, "
        f"best validation cost {best}"
    )

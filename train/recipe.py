"""A recipe: stages of training one after the other, from the first labels to the refined network.

A recipe is a TOML file (``train/recipes/``):

- ``[shared]`` holds options of all stages.
- Each ``[[stages]]`` has a ``name``, the ``command`` that trains (``imitate``, ``reinforce`` or ``improve``), for
  ``reinforce`` perhaps a ``preset``, and its ``options``, named as in the command's configuration. Its budget is
  ``steps``, or ``seconds`` of training and validation in all, or both. A stage that starts from weights may have a
  ``share``: it then ends with the weights it started from and this share of what it has learnt.

Every stage but the first starts from the weights of the stage before (``init = "previous"``), which may also play the
beginnings of its games (``roll_in = "previous"``). Without a ``share``, a stage ends with its best weights.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError

from mtsp_env.reading import read_file
from train.config import RunConfig
from train.imitate import ImitationLearner
from train.improve import ImproveLearner
from train.learner import Learner
from train.presets import PRESETS
from train.reinforce import ReinforceLearner
from train.reinforce_config import ReinforceConfig
from train.supervised_config import ImitateConfig, ImproveConfig, SupervisedConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PREVIOUS = "previous"  # as `init` or `roll_in`: the weights of the stage before
UNLIMITED = 10**9  # steps of a stage whose budget is in seconds alone
SET_BY_THE_COMMAND = ("out", "resume")


class Command(NamedTuple):
    """A command that can train a stage."""

    config: type[RunConfig]
    learner: type[Learner]


COMMANDS: dict[str, Command] = {
    "imitate": Command(ImitateConfig, ImitationLearner),
    "reinforce": Command(ReinforceConfig, ReinforceLearner),
    "improve": Command(ImproveConfig, ImproveLearner),
}


@dataclass(frozen=True)
class Stage:
    """One stage of a recipe.

    Attributes:
        name: names its folder and its entry in the log.
        command: a key of ``COMMANDS``.
        config: its options. ``seconds`` is its whole budget, and ``init`` and ``roll_in`` may be ``PREVIOUS``.
        share: of what it has learnt, in (0, 1]: it ends with (1 - share) times the weights it started from, plus share
            times its best ones.
    """

    name: str
    command: str
    config: RunConfig
    share: float = 1.0


def read_recipe(file: Path) -> list[Stage]:
    """The stages of a TOML file.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not TOML, or something in it is unknown, missing or out of range.
    """
    try:
        recipe = tomllib.loads(read_file(file).decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: not a TOML file ({error})") from error
    _check_keys(str(file), recipe, required=("stages",), optional=("shared",))
    if not isinstance(recipe["stages"], list) or not recipe["stages"]:
        raise ValueError(f"{file}: stages must be a list of at least 1 stage, got {recipe['stages']!r}")
    stages: list[Stage] = []
    for number, entry in enumerate(recipe["stages"], 1):
        stages.append(_read_stage(f"{file}: stage {number}", entry, recipe.get("shared", {}), first=number == 1))
        if [stage.name for stage in stages].count(stages[-1].name) > 1:
            raise ValueError(f"{file}: stage {number}: name must differ from the other stages', got {entry['name']!r}")
    return stages


def _read_stage(where: str, entry: Any, shared: Any, first: bool) -> Stage:
    _check_keys(where, entry, required=("name", "command"), optional=("preset", "share", "options"))
    name, command = entry["name"], entry["command"]
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][\w-]*", name):
        raise ValueError(f"{where}: name must consist of letters, digits, '-' and '_', got {name!r}")
    where = f"{where} ({name})"
    if command not in COMMANDS:
        raise ValueError(f"{where}: unknown command {command!r}; choose from {sorted(COMMANDS)}")
    options = _merged(shared, entry.get("options", {}))
    for option in SET_BY_THE_COMMAND:
        if option in options:
            raise ValueError(f"{where}: {option} is set by the command line, not by a recipe")
    if "steps" not in options and "seconds" not in options:
        raise ValueError(f"{where}: steps or seconds must be given, the stage's budget")
    if not first:
        options.setdefault("init", PREVIOUS)
    elif PREVIOUS in (options.get("init"), options.get("roll_in")):
        raise ValueError(f"{where}: no stage comes before the first: name the weights of init and roll_in")
    if "steps" not in options:
        options["steps"] = UNLIMITED
        if issubclass(COMMANDS[command].config, SupervisedConfig):
            options.setdefault("anneal_seconds", options["seconds"])
    if "preset" in entry:
        if command != "reinforce" or entry["preset"] not in PRESETS:
            raise ValueError(f"{where}: preset must be one of {sorted(PRESETS)} of reinforce, got {entry['preset']!r}")
        options = _merged(PRESETS[entry["preset"]].to_dict(), options)
    config, share = _config(where, COMMANDS[command].config, options), entry.get("share", 1.0)
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0.0 < share <= 1.0:
        raise ValueError(f"{where}: share must be a number above 0 and at most 1, got {share!r}")
    if share < 1.0 and config.init is None:
        raise ValueError(f"{where}: share must be 1 in a stage that starts from no weights, got {share!r}")
    return Stage(name, command, config, float(share))


def _config(where: str, kind: type[RunConfig], options: Mapping[str, Any]) -> RunConfig:
    """The configuration with these options, whose names, types and values are checked."""
    try:
        text = json.dumps(options, default=str)
        return TypeAdapter(kind).validate_json(text, strict=True, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        option = ".".join(map(str, first["loc"]))
        message = first["msg"].removeprefix("Value error, ")
        known = f"; {kind.__name__} has no such option" if first["type"] == "unexpected_keyword_argument" else ""
        raise ValueError(f"{where}: {f'{option}: ' if option else ''}{message}{known}") from error


def _check_keys(where: str, table: Any, required: tuple[str, ...], optional: tuple[str, ...]) -> None:
    if not isinstance(table, dict):
        raise ValueError(f"{where}: must be a table with {list(required)}, got {table!r}")
    for key in required:
        if key not in table:
            raise ValueError(f"{where}: {key} is missing")
    for key in table.keys() - {*required, *optional}:
        raise ValueError(f"{where}: unknown key {key!r}; choose from {sorted((*required, *optional))}")


def _merged(below: Any, above: Any) -> dict[str, Any]:
    """Options of two tables; those ``above`` count if both have them."""
    for table in (below, above):
        if not isinstance(table, dict):
            raise ValueError(f"options must be a table, got {table!r}")
    merged = dict(below)
    for name, value in above.items():
        merged[name] = _merged(merged[name], value) if isinstance(value, dict) and name in merged else value
    return merged

"""The command ``mtsp``: solve and generate instances, serve. Imports torch only to solve with a policy.

``arguments.parse`` reads the signatures and docstrings of ``solve`` and ``generate``.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from dan_policy.arguments import (
    SECONDS,
    Positional,
    arg,
    check_docstrings,
    check_working_directory,
    default,
    open_streams,
    parse,
    refuse,
    whole,
)
from dan_policy.serve import serve
from mtsp_env import render
from mtsp_env.distributions import sample
from mtsp_env.files import read_instance, write_instance, write_tours
from mtsp_env.instance import Instance, Tours
from mtsp_env.machine import check_memory
from mtsp_env.reading import printable
from mtsp_env.tours import lower_bound, tour_lengths, tour_times
from mtsp_env.tsplib import read_tsplib
from mtsp_env.version import __version__

DEFAULT_SAMPLES = 64  # the paper's DAN(s.64)
MOST_AGENTS = 100_000  # agents beyond the number of cities stay at home anyway
BYTES_PER_NODE = 500  # of a generated instance, as lists and text
DESCRIPTION = """\
The MinMax multiple travelling salesman problem: plan one tour per agent, from the depot and back, so that together they
visit all cities and the longest tour is as short as possible.

examples:
  mtsp solve examples/europe.tsp --agents 5 --plot tours.png
  mtsp generate --nodes 100 --agents 10 big.json && mtsp solve big.json --decode sample
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return 0. Bad input exits with 2 and one line on stderr; Ctrl-C returns 130, silently."""
    open_streams()
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"mtsp {__version__}")
        sys.exit(0)
    try:
        command = parse([solve, generate, serve], DESCRIPTION, argv)
        command()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output, such as `head`, has closed it
        return 1
    except OSError as error:
        refuse(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))
    except (ValueError, ImportError) as error:
        refuse(str(error))
    except MemoryError as error:
        refuse(f"out of memory: {error}")
    return 0


# mtsp solve: everything that can be wrong with the input is reported before the first instance is solved


@dataclass(frozen=True)
class Plan:
    """The part of a ``Solution`` that is printed; the module of ``Solution`` imports torch."""

    tours: Tours
    seconds: float
    method: str


Solver = Callable[[Instance], Plan]


def solve(
    files: Annotated[Positional[tuple[str, ...]], arg(metavar="FILE", help_behavior_hint="(at least one)")],
    agents: Annotated[int | None, whole(1, "M", MOST_AGENTS), default("as the file says")] = None,
    seed: Annotated[int, whole(0, "S")] = 0,
    method: Literal["dan", "reference"] = "dan",
    seconds: Annotated[float | None, SECONDS, default("500 n iterations")] = None,
    policy: Annotated[str | None, arg(metavar="NAME|FILE"), default("default")] = None,
    network: Annotated[str | None, arg(metavar="MODULE:FACTORY"), default("as the file says")] = None,
    decode: Annotated[Literal["greedy", "sample"] | None, arg(metavar="{greedy,sample}"), default("greedy")] = None,
    samples: Annotated[int | None, whole(1, "K"), default(str(DEFAULT_SAMPLES))] = None,
    augment: Annotated[bool, default("off")] = False,
    reconstruct: Annotated[int | None, whole(0, "ROUNDS"), default("0")] = None,
    device: Annotated[str | None, arg(metavar="DEVICE"), default("cpu")] = None,
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"] | None, arg(metavar="{auto,float32,bfloat16}"), default("auto")
    ] = None,
    view: Annotated[int | None, whole(1, "K"), default("all below 400 nodes, else 100")] = None,
    improve: Annotated[float | None, SECONDS, default("no improvement")] = None,
    plot: Annotated[str | None, arg(metavar="PATH"), default("no picture")] = None,
    animate: Annotated[str | None, arg(metavar="PATH"), default("no animation")] = None,
    html: Annotated[str | None, arg(metavar="PATH"), default("no page")] = None,
    out: Annotated[str | None, arg(metavar="PATH"), default("no file")] = None,
    as_json: Annotated[bool, arg(name="json"), default("off")] = False,
) -> None:
    """Plan tours and print them. Lengths are in the units of the file.

    examples:
      mtsp solve examples/europe.tsp --agents 5 --plot tours.png
      mtsp solve a.tsp b.tsp --agents 4 --out tours.json     (writes tours-a.json, tours-b.json)
      mtsp solve big.json --decode sample --samples 256 --device cuda --json
      mtsp solve big.json --improve 1                        (continues from the policy's tours for a second)
      mtsp solve big.json --policy mine.safetensors --network mine:make_network
      mtsp solve big.json --method reference --seconds 0.1   (the shortest tours, without a policy)

    Args:
        files: TSPLIB files (.tsp), or .json files that `mtsp generate` wrote
        agents: number of agents; a .tsp file does not say it
        seed: seed of everything random
        method: dan plans with a trained network, reference with the reference solver alone, which needs no torch
        seconds: with --method reference: time per file
        policy: a shipped model, or a file that `dan_policy.save` wrote
        network: package.module:factory of a network of your own; its weights are those of --policy, if given
        decode: greedy plays the likeliest actions once, sample takes the best of several games of drawn actions
        samples: with --decode sample: number of games
        augment: play in the eight symmetries of the square and take the best (greedy: eight games instead of one)
        reconstruct: rounds in which the policy plans parts of the best tours again
        device: cpu, cuda, cuda:1, ...
        precision: the network's precision; auto takes bfloat16 if that is faster
        view: agents see at most this many cities, the nearest unvisited ones
        improve: time for which the reference solver improves the policy's tours
        plot: draw the tours: .png, .svg, .pdf, ...
        animate: draw the agents on their tours: .gif, or .mp4 (extra video)
        html: write a page for the browser, with a slider over time and the table
        out: write the tours as JSON
        as_json: print one JSON object per file and nothing else
    """
    check_working_directory()
    options: dict[str, dict[str, Any]] = {
        "dan": {
            "policy": policy,
            "network": network,
            "decode": decode,
            "samples": samples,
            "augment": augment,
            "reconstruct": reconstruct,
            "device": device,
            "precision": precision,
            "view": view,
            "improve": improve,
        },
        "reference": {"seconds": seconds},
    }
    if not files:
        raise ValueError("required: FILE, at least one")
    _check_options(method, options)
    instances = [_read(Path(file), agents) for file in files]
    paths = {"out": out, "plot": plot, "animate": animate, "html": html}
    outputs = {option: _outputs(path, instances) for option, path in paths.items()}
    _check_outputs(files, outputs)
    solver = _dan(seed=seed, **options["dan"]) if method == "dan" else _reference(seconds, seed)
    show = (lambda record: print(json.dumps(record), flush=True)) if as_json else _table()

    for number, instance in enumerate(instances):
        plan = solver(instance)
        record = _record(instance, plan)
        show(record)
        for option, write in WRITERS.items():
            path = outputs[option][number]
            if path is not None:
                with _writing(path, quiet=as_json):
                    write(path, instance, record)


def _save_page(path: Path, instance: Instance, record: dict[str, Any]) -> None:
    """Below its table, a page says what the table on the terminal says: how it was planned, and the lower bound."""
    bound = render.format_lengths([record["makespan"], record["lower_bound"]])[1]
    notes = [f"{record['method']} in {record['seconds']:.3g} s.", f"No makespan can be below {bound}."]
    render.save_page(path, instance, record["tours"], notes=notes)


WRITERS: dict[str, Callable[[Path, Instance, dict[str, Any]], None]] = {
    "out": lambda path, instance, record: write_tours(path, **record),
    "plot": lambda path, instance, record: render.save_picture(path, instance, record["tours"]),
    "animate": lambda path, instance, record: render.animate(path, instance, record["tours"]),
    "html": _save_page,
}


def _check_options(method: str, options: dict[str, dict[str, Any]]) -> None:
    for other, values in options.items():
        given = [name for name, value in values.items() if value not in (None, False)]
        if given and other != method:
            raise ValueError(f"--{given[0]} needs --method {other}")
    if options["dan"]["samples"] is not None and options["dan"]["decode"] != "sample":
        raise ValueError("--samples needs --decode sample")


def _dan(
    seed: int,
    policy: str | None,
    network: str | None,
    decode: Literal["greedy", "sample"] | None,
    samples: int | None,
    reconstruct: int | None,
    device: str | None,
    precision: Literal["auto", "float32", "bfloat16"] | None,
    **options: Any,
) -> Solver:
    check_docstrings()
    try:
        import dan_policy

        plan_tours = dan_policy.solve
    except ImportError as error:
        raise ImportError(f'solving needs torch and torchrl ({error}): pip install "mtsp-env[dan]"') from error
    if network is None:
        player: Any = policy or "default"
    else:
        player = dan_policy.load(policy, network=network) if policy else dan_policy.build(network)

    def plan(instance: Instance) -> Plan:
        solution = plan_tours(
            instance,
            policy=player,
            decode=decode or "greedy",
            samples=samples or DEFAULT_SAMPLES,
            reconstruct=reconstruct or 0,
            seed=seed,
            device=device or "cpu",
            precision=precision or "auto",
            **options,
        )
        return Plan(solution.tours, solution.seconds, solution.method)

    return plan


def _reference(seconds: float | None, seed: int) -> Solver:
    from mtsp_env import reference

    reference.compile_kernels()

    def plan(instance: Instance) -> Plan:
        start = time.perf_counter()
        tours = reference.improve(instance, seconds=seconds, seed=seed)
        return Plan(tours, time.perf_counter() - start, "reference")

    return plan


def _table() -> Callable[[dict[str, Any]], None]:
    try:
        from dan_policy.table import print_table
    except ImportError as error:
        raise ImportError(f'the table needs rich ({error}): pip install "mtsp-env[dan]", or add --json') from error
    return print_table


def _read(path: Path, n_agents: int | None) -> Instance:
    suffix = path.suffix.lower()
    if suffix == ".json":
        instance = read_instance(path, n_agents)
        if instance.n_agents > MOST_AGENTS:
            raise ValueError(f"{path}: n_agents must be at most {MOST_AGENTS}, got {instance.n_agents}")
        return instance
    if suffix != ".tsp":
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; choose from ['.json', '.tsp']")
    if n_agents is None:
        raise ValueError(f"{path}: a TSPLIB file does not say how many agents there are; add --agents")
    return read_tsplib(path, n_agents)


def _outputs(path: str | None, instances: Sequence[Instance]) -> list[Path | None]:
    """Where each instance's result goes: ``path``, with the instance's name in it if there are several."""
    if path is None or len(instances) == 1:
        return [Path(path) if path else None for _ in instances]
    target = Path(path)
    outputs: list[Path | None] = []
    for instance in instances:
        name = re.sub(r"[^\w.+-]+", "_", instance.name) or "instance"
        stem, number = f"{target.stem}-{name}", 2
        while (output := target.with_name(stem + target.suffix)) in outputs:
            stem, number = f"{target.stem}-{name}-{number}", number + 1
        outputs.append(output)
    return outputs


def _check_outputs(files: Sequence[str], outputs: Mapping[str, Sequence[Path | None]]) -> None:
    taken = {os.path.realpath(file) for file in files}  # unlike Path.resolve, it raises no error in a loop of links
    for path in filter(None, itertools.chain(*outputs.values())):
        if not path.parent.is_dir():
            raise ValueError(f"{path}: no such folder")
        if os.path.realpath(path) in taken:
            raise ValueError(f"{path}: would overwrite another file of this command")
        taken.add(os.path.realpath(path))
    for plot in filter(None, outputs["plot"]):
        render.check_suffix(plot)
    for animation in filter(None, outputs["animate"]):
        render.check_animation_suffix(animation)
    for page in filter(None, outputs["html"]):
        if page.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"{page}: unknown suffix {page.suffix!r}; choose from ['.html', '.htm']")


def _record(instance: Instance, plan: Plan) -> dict[str, Any]:
    """The facts about a plan, in the file's units; the judge measures the lengths, not the solver."""
    lengths = tour_lengths(instance, plan.tours) * instance.scale
    times = tour_times(instance, plan.tours) * instance.scale
    return {
        "name": instance.name,
        "n_nodes": instance.n_nodes,
        "n_agents": instance.n_agents,
        "method": plan.method,
        "seconds": plan.seconds,
        "makespan": float(times.max()),
        "lower_bound": lower_bound(instance) * instance.scale,
        "lengths": lengths.tolist(),
        "times": times.tolist(),  # if plain, the lengths
        "tours": [[int(node) for node in tour] for tour in plan.tours],
    }


# mtsp generate


def generate(
    out: Annotated[Positional[str], arg(metavar="OUT.json")],
    nodes: Annotated[int, whole(2, "N")],
    agents: Annotated[int, whole(1, "M", MOST_AGENTS)],
    seed: Annotated[int, whole(0, "S")] = 0,
    distribution: str = "uniform",
) -> None:
    """Write a random instance in the unit square.

    example:
      mtsp generate --nodes 100 --agents 10 --seed 0 --distribution clustered big.json

    Args:
        out: where to write it.
        nodes: number of nodes, the depot included.
        agents: number of agents.
        seed: the same seed gives the same instance.
        distribution: where the nodes lie: uniform or clustered.
    """
    path = Path(out)
    if path.suffix.lower() != ".json":
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; choose from ['.json']")
    check_memory("nodes", nodes, BYTES_PER_NODE)
    problem = sample(distribution, np.random.default_rng(seed), 1, nodes, agents)
    with _writing(path):
        write_instance(path, problem.instance(0, f"{distribution}-{nodes}-{seed}"))


@contextmanager
def _writing(path: Path, quiet: bool = False) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ValueError(f"{path}: cannot write it ({error.strerror or error})") from error
    if not quiet:
        print(f"wrote {printable(str(path))}")


if __name__ == "__main__":
    sys.exit(main())

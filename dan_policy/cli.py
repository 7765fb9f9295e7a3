"""The command ``mtsp``: solve instances from files, generate instances. Imports torch only to solve with a policy."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from mtsp_env.distributions import DISTRIBUTIONS, sample
from mtsp_env.files import read_instance, write_instance, write_tours
from mtsp_env.instance import Instance, Tours
from mtsp_env.render import check_suffix, save_picture
from mtsp_env.tours import lower_bound, tour_lengths
from mtsp_env.tsplib import read_tsplib
from mtsp_env.version import __version__

METHODS = {  # each with the options that are its own
    "dan": ("policy", "decode", "samples", "augment", "device", "precision", "view", "improve"),
    "reference": ("seconds",),
}
DEFAULT_SAMPLES = 64  # the paper's DAN(s.64)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return 0. Bad input exits with 2 and one line on stderr; Ctrl-C gives 130, silently."""
    parser = _parser()
    try:
        args = parser.parse_args(argv)
        args.run(args)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output, such as `head`, has seen enough
        return 1
    except OSError as error:
        parser.error(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    return 0


# mtsp solve: everything that can be wrong with the input is found before the first instance is solved


class Plan(NamedTuple):
    """What the output needs of a Solution, whose own module imports torch."""

    tours: Tours
    seconds: float
    method: str


def _solve(args: argparse.Namespace) -> None:
    _check_options(args)
    instances = [_read(Path(file), args.agents) for file in args.files]
    plots, outs = _outputs(args.plot, instances), _outputs(args.out, instances)
    _check_outputs(args.files, plots, outs)
    solve = {"dan": _dan, "reference": _reference}[args.method](args)
    show = None if args.json else _table()

    for instance, plot, out in zip(instances, plots, outs, strict=True):
        plan = solve(instance)
        record = _record(instance, plan)
        if show is None:
            print(json.dumps(record), flush=True)
        else:
            show(record)
        if out is not None:
            with _writing(out, quiet=args.json):
                write_tours(out, **record)
        if plot is not None:
            with _writing(plot, quiet=args.json):
                save_picture(plot, instance, plan.tours)


def _check_options(args: argparse.Namespace) -> None:
    for method, options in METHODS.items():
        given = [option for option in options if getattr(args, option) is not None]
        if given and method != args.method:
            raise ValueError(f"--{given[0]} needs --method {method}")
    if args.samples is not None and args.decode != "sample":
        raise ValueError("--samples needs --decode sample")


def _dan(args: argparse.Namespace) -> Callable[[Instance], Plan]:
    try:
        from dan_policy import solve
    except ImportError as error:
        raise ImportError(f'solving needs torch and torchrl ({error}): pip install "mtsp-env[dan]"') from error

    def plan(instance: Instance) -> Plan:
        solution = solve(
            instance,
            policy=args.policy or "default",
            decode=args.decode or "greedy",
            samples=args.samples or DEFAULT_SAMPLES,
            seed=args.seed,
            device=args.device or "cpu",
            improve=args.improve,
            precision=args.precision or "auto",
            view=args.view,
            augment=args.augment or False,
        )
        return Plan(solution.tours, solution.seconds, solution.method)

    return plan


def _reference(args: argparse.Namespace) -> Callable[[Instance], Plan]:
    from mtsp_env import reference

    reference.compile_kernels()

    def plan(instance: Instance) -> Plan:
        start = time.perf_counter()
        tours = reference.improve(instance, seconds=args.seconds, seed=args.seed)
        return Plan(tours, time.perf_counter() - start, "reference")

    return plan


def _table() -> Callable[[dict], None]:
    try:
        from dan_policy.table import print_table
    except ImportError as error:
        raise ImportError(f'the table needs rich ({error}): pip install "mtsp-env[dan]", or add --json') from error
    return print_table


def _read(path: Path, n_agents: int | None) -> Instance:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_instance(path, n_agents)
    if suffix != ".tsp":
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; choose from ['.json', '.tsp']")
    if n_agents is None:
        raise ValueError(f"{path}: a TSPLIB file does not say how many agents there are; add --agents")
    return read_tsplib(path, n_agents)


def _outputs(path: str | None, instances: Sequence[Instance]) -> list[Path | None]:
    """Where each instance's result goes: ``path``, with the instance's name in it where there are several."""
    if path is None or len(instances) == 1:
        return [Path(path) if path else None for _ in instances]
    target, found = Path(path), []
    for instance in instances:
        name = re.sub(r"[^\w.+-]+", "_", instance.name) or "instance"
        stem, number = f"{target.stem}-{name}", 2
        while (output := target.with_name(stem + target.suffix)) in found:
            stem, number = f"{target.stem}-{name}-{number}", number + 1
        found.append(output)
    return found


def _check_outputs(files: Sequence[str], plots: Sequence[Path | None], outs: Sequence[Path | None]) -> None:
    taken = {Path(file).resolve() for file in files}
    for path in filter(None, [*plots, *outs]):
        if not path.parent.is_dir():
            raise ValueError(f"{path}: no such folder")
        if path.resolve() in taken:
            raise ValueError(f"{path}: would overwrite another file of this command")
        taken.add(path.resolve())
    for plot in filter(None, plots):
        check_suffix(plot)


def _record(instance: Instance, plan: Plan) -> dict:
    """What there is to say about a plan, in the file's units; measured by the judge, not by the solver."""
    lengths = tour_lengths(instance, plan.tours) * instance.scale
    return {
        "name": instance.name,
        "n_nodes": instance.n_nodes,
        "n_agents": instance.n_agents,
        "method": plan.method,
        "seconds": plan.seconds,
        "makespan": float(lengths.max()),
        "lower_bound": lower_bound(instance) * instance.scale,
        "lengths": lengths.tolist(),
        "tours": [[int(node) for node in tour] for tour in plan.tours],
    }


# mtsp generate


def _generate(args: argparse.Namespace) -> None:
    path = Path(args.out)
    if path.suffix.lower() != ".json":
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; choose from ['.json']")
    problem = sample(args.distribution, np.random.default_rng(args.seed), 1, args.nodes, args.agents)
    instance = problem.instance(0, f"{args.distribution}-{args.nodes}-{args.seed}")
    with _writing(path):
        write_instance(path, instance)


@contextmanager
def _writing(path: Path, quiet: bool = False) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ValueError(f"{path}: cannot write it ({error.strerror or error})") from error
    if not quiet:
        print(f"wrote {path}")


# Arguments


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, where argparse would print the usage too."""
        self.exit(2, f"mtsp: error: {' '.join(message.split())}\n")


def _parser() -> argparse.ArgumentParser:
    layout = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        prog="mtsp",
        description="The MinMax multiple travelling salesman problem: one tour per agent from the depot and back,\n"
        "together through all cities, the longest as short as can be.",
        epilog="examples:\n"
        "  mtsp solve examples/europe.tsp --agents 5 --plot tours.png\n"
        "  mtsp generate --nodes 100 --agents 10 big.json && mtsp solve big.json --decode sample\n"
        "More on a command: mtsp COMMAND --help",
        formatter_class=layout,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"mtsp {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    solve = commands.add_parser(
        "solve",
        help="plan tours with a trained policy or the reference solver",
        description="Plan tours and print them; lengths are in the file's units.",
        epilog="examples:\n"
        "  mtsp solve examples/europe.tsp --agents 5 --plot tours.png\n"
        "  mtsp solve a.tsp b.tsp --agents 4 --out tours.json     (writes tours-a.json, tours-b.json)\n"
        "  mtsp solve big.json --decode sample --samples 256 --device cuda --json\n"
        "  mtsp solve big.json --improve 1                        (go on from the policy's tours for a second)\n"
        "  mtsp solve big.json --method reference --seconds 0.1   (the shortest tours soonest, no policy)",
        formatter_class=layout,
        allow_abbrev=False,
    )
    solve.set_defaults(run=_solve)
    option = solve.add_argument
    option("files", nargs="+", metavar="FILE", help="TSPLIB (.tsp) or what `mtsp generate` wrote (.json)")
    option("--agents", type=_whole(1), metavar="M", help="number of agents; default: what a .json file says")
    option("--seed", type=_whole(0), default=0, metavar="S", help="of all that is random (default: %(default)s)")
    option(
        "--method",
        choices=METHODS,
        default="dan",
        help="a trained policy, or the reference solver alone, which needs no torch (default: %(default)s)",
    )
    option(
        "--seconds", type=_seconds, metavar="SECONDS", help="--method reference: per file (default: 500 n iterations)"
    )
    option("--policy", help="--method dan: a shipped policy or a .safetensors file (default: default)")
    option(
        "--decode",
        choices=("greedy", "sample"),
        help="--method dan: likeliest actions once, or the best of --samples draws (default: greedy)",
    )
    option("--samples", type=_whole(1), metavar="K", help=f"with --decode sample (default: {DEFAULT_SAMPLES})")
    option(
        "--augment",
        action="store_const",
        const=True,
        help="--method dan: play in the square's eight symmetries and take the best (greedy: eight games, not one)",
    )
    option("--device", help="--method dan: cpu, cuda, cuda:1, ... (default: cpu)")
    option(
        "--precision",
        choices=("auto", "float32", "bfloat16"),
        help="--method dan: auto takes bfloat16 where that is faster (default: auto)",
    )
    option(
        "--view",
        type=_whole(1),
        metavar="K",
        help="--method dan: agents see the nearest K unvisited cities (default: all below 400 nodes, else 100)",
    )
    option("--improve", type=_seconds, metavar="SECONDS", help="--method dan: polish its tours for so many seconds")
    option("--plot", metavar="PATH", help="draw the tours: .png, .svg, .pdf, ...")
    option("--out", metavar="PATH", help="write the tours as JSON")
    option("--json", action="store_true", help="print one JSON object per file and nothing else")

    generate = commands.add_parser(
        "generate",
        help="write a random instance",
        description="Write a random instance in the unit square.",
        epilog="example:\n  mtsp generate --nodes 100 --agents 10 --seed 0 --distribution clustered big.json",
        formatter_class=layout,
        allow_abbrev=False,
    )
    generate.set_defaults(run=_generate)
    option = generate.add_argument
    option("out", metavar="OUT.json", help="where to write it")
    option("--nodes", type=_whole(2), required=True, metavar="N", help="number of nodes, the depot included")
    option("--agents", type=_whole(1), required=True, metavar="M", help="number of agents")
    option("--seed", type=_whole(0), default=0, metavar="S", help="same seed, same instance (default: %(default)s)")
    option(
        "--distribution",
        choices=sorted(DISTRIBUTIONS),
        default="uniform",
        help="of the nodes: %(choices)s (default: %(default)s)",
    )
    return parser


def _whole(minimum: int) -> Callable[[str], int]:
    """A type for argparse: a whole number from ``minimum`` to 2^63 - 1."""

    def parse(text: str) -> int:
        value = int(text) if re.fullmatch(r"[+-]?\d{1,19}", text) else math.inf
        if not minimum <= value < 2**63:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {minimum}, got {text!r}")
        return int(value)

    return parse


def _seconds(text: str) -> float:
    """A type for argparse: a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"must be a finite number of seconds above 0, got {text!r}")
    return value


if __name__ == "__main__":
    sys.exit(main())

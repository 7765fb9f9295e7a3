"""The mean of several networks' weights."""

from __future__ import annotations

from pathlib import Path

import tyro

from dan_policy.registry import load, load_config, load_extra, save


def average(files: tyro.conf.Positional[tuple[str, ...]], out: Path, network: str | None = None) -> None:
    """Write the mean of the weights of runs that started from the same ones ("model soup", Wortsman et al. 2022).

    Runs with a common ancestor learn similar weights, and their noise cancels. Without one, the mean may be worse than
    each of them: compare them with `validate`.

    Args:
        files: weights, or names of shipped models, at least 2; one that is named twice counts twice.
        out: file to write.
        network: package.module:factory, for weights of a network of your own.

    Raises:
        OSError: no such weights, or ``out`` cannot be written.
        ValueError: fewer than 2 files, or networks of different kinds or shapes.
    """
    if len(files) < 2:
        raise ValueError(f"name at least 2 files to average, got {len(files)}")
    networks = [load(file, network=network) for file in files]
    mean = load(files[0], network=network)
    configs = [getattr(one, "config", load_config(file)) for one, file in zip(networks, files, strict=True)]
    for file, config in zip(files, configs, strict=True):
        if config != configs[0]:
            raise ValueError(f"{file} has another configuration than {files[0]}: {config}, {configs[0]}")
    states = [one.state_dict() for one in networks]
    mean.load_state_dict({name: sum(state[name] for state in states) / len(states) for name in states[0]})
    out.parent.mkdir(parents=True, exist_ok=True)
    save(out, mean, network, load_config(files[0]), averaged=[load_extra(file) for file in files])

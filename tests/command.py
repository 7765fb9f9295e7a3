"""Helpers that run the command ``mtsp``, in this process or in another one."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from dan_policy.cli import main


def refused(capsys, *argv: str) -> str:
    """The one line on stderr of a command that is refused."""
    with pytest.raises(SystemExit) as caught:
        main(argv)
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.out == ""
    assert printed.err.startswith("mtsp: error: ")
    assert printed.err.count("\n") == 1
    assert printed.err.endswith("\n")
    return printed.err


def run(*argv: str, missing: Sequence[str] = (), **options) -> subprocess.CompletedProcess:
    """The command as a process of its own, in which importing the ``missing`` modules fails."""
    code = f"""
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {tuple(missing)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)


sys.meta_path.insert(0, Missing())
from dan_policy.cli import main

sys.exit(main(sys.argv[1:]))
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.run([sys.executable, "-c", code, *argv], env=environment, text=True, check=False, **options)

"""The code of every page runs as it stands, its commands and options exist, and so do the files that it links to."""

import functools
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import pytest

from dan_policy.cli import main
from mtsp_env.instance import FIELDS, describe_fields
from mtsp_env.rules import OBSERVED, STATE_FIELDS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\S+) ?(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)  # language, note, code


def fences(page: Path, language: str) -> list[tuple[str, str]]:
    """The note (what follows the language on its line) and the code of every block of one language."""
    blocks = FENCE.findall(page.read_text(encoding="utf-8"))
    return [(note, code) for block_language, note, code in blocks if block_language == language]


def python_examples(page: Path) -> list[str]:
    """Every Python block to run; blocks that the reader is asked to save as files are left out."""
    return [code for note, code in fences(page, "python") if not note]


def folder_of(page: Path, folder: Path) -> Path:
    """A folder as a reader of the page has it: the examples, and the files that the page says to save."""
    (folder / "examples").symlink_to(ROOT / "examples")
    (folder / "europe.tsp").symlink_to(ROOT / "examples" / "europe.tsp")
    for note, code in fences(page, "python"):
        if note:
            (folder / note.removeprefix("file=")).write_text(code, encoding="utf-8")
    return folder


def run(command: list[str], folder: Path) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "300", "MPLBACKEND": "Agg"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def command_lines(page: Path) -> list[list[str]]:
    """The words of every command of ours in the shell blocks and in the inline code of a page."""
    text = page.read_text(encoding="utf-8")
    shell = "\n".join(code for _, code in fences(page, "sh")).replace("\\\n", " ")
    inline = re.findall(r"`((?:python -m|mtsp) [^`]+)`", FENCE.sub("", text))
    lines = [shlex.split(line, comments=True) for line in [*shell.splitlines(), *inline]]
    return [words for words in lines if words and (words[0] == "mtsp" or "-m" in words)]


def program_and_options(words: list[str]) -> tuple[tuple[str, ...], list[str]]:
    """The words that name a command's program and subcommands, and its long options.

    >>> program_and_options("python -m train reinforce quick --out runs/mine".split())
    (('-m', 'train', 'reinforce', 'quick'), ['--out'])
    """
    start = words.index("mtsp") if words[0] == "mtsp" else words.index("-m")
    module = 1 if words[start] == "mtsp" else 2
    subcommands = []
    for word in words[start + module :]:
        if not re.fullmatch(r"[a-z][a-z0-9-]*", word):
            break
        subcommands.append(word)
    options = [word.partition("=")[0] for word in words[start:] if word.startswith("--")]
    return (*words[start : start + module], *subcommands), options


@functools.cache
def help_of(program: tuple[str, ...]) -> str:
    """What a program prints about itself, run in this process: most of them import torch, which takes seconds."""
    subcommands = program[1:] if program[0] == "mtsp" else program[2:]
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(output):
        patch.setenv("COLUMNS", "300")
        patch.setattr(sys, "argv", [shlex.join(program), *subcommands, "--help"])
        with pytest.raises(SystemExit) as end:
            main() if program[0] == "mtsp" else runpy.run_module(program[1], run_name="__main__")
    assert not end.value.code, f"{shlex.join(program)} --help: {output.getvalue()}"
    return output.getvalue()


@pytest.mark.parametrize("page", [page for page in PAGES if python_examples(page)], ids=lambda page: page.stem)
@pytest.mark.slow
def test_examples_run(page: Path, tmp_path: Path) -> None:
    """Each block by itself, with no names from those before it, but in one process: most of them import torch."""
    code = f"""
for number, example in enumerate({python_examples(page)!r}):
    print("<", number, ">", sep="", flush=True)
    exec(compile(example, "block %d" % number, "exec"), {{"__name__": "__main__"}})
"""
    result = run([sys.executable, "-W", "ignore", "-c", code], folder_of(page, tmp_path))
    assert result.returncode == 0, result.stderr
    printed = re.split(r"^<\d+>$", result.stdout, flags=re.MULTILINE)[1:]
    assert len(printed) == len(python_examples(page)) and all(map(str.strip, printed)), result.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not link.startswith("http") and not (page.parent / link).exists()]
    assert not missing


def test_paths_in_the_readme_exist() -> None:
    """The first column of the table of files holds paths; a bare name stands for a file beside the path before it."""
    table = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Where things are")[2]
    cells = re.findall(r"^\| (`[^|]+) \|", table, re.MULTILINE)
    assert cells
    for cell in cells:
        paths = [Path(path) for path in re.findall(r"`([^`]+)`", cell)]
        for path in paths:
            assert (ROOT / path).exists() or (ROOT / paths[0].parent / path).exists(), path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_make_targets_exist(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(encoding="utf-8"), re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_and_options_exist(page: Path) -> None:
    for words in command_lines(page):
        program, options = program_and_options(words)
        if program[0] == "-m" and "." in program[1]:  # a module that runs at once, without a command line of its own
            assert find_spec(program[1]), shlex.join(words)
            continue
        unknown = [option for option in options if option not in help_of(program)]
        assert not unknown, f"{shlex.join(words)}: the help does not name {unknown}"


def test_commands_are_found_in_pages() -> None:
    programs = {program_and_options(words)[0] for words in command_lines(ROOT / "README.md")}
    assert {("mtsp", "solve"), ("-m", "train", "imitate"), ("-m", "train", "reinforce", "quick")} <= programs


@pytest.mark.parametrize("fields", [FIELDS, STATE_FIELDS], ids=["problem", "state"])
def test_the_fields_are_documented_as_they_are(fields: dict) -> None:
    assert describe_fields(fields) in (ROOT / "docs" / "problem.md").read_text(encoding="utf-8")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_the_extra_keys_of_worlds_are_documented_as_they_are() -> None:
    table = describe_fields(OBSERVED).replace("| field |", "| key |")
    assert table in (ROOT / "docs" / "problem.md").read_text(encoding="utf-8")

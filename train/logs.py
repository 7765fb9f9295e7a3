"""A run's numbers over its steps, as CSV files and for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from mtsp_env.reading import read_file
from mtsp_env.writing import atomic_write


class Logs:
    """Appends rows (step, value) to ``logs/scalars/NAME.csv``, one file for each number, and TensorBoard's events.

    A run that is killed has logged steps after its last checkpoint, which its continuation takes again: what is logged
    of steps after ``step`` is dropped.

    Args:
        folder: the run's folder.
        step: the step at which the run begins or continues.
        tensorboard: write TensorBoard's events as well.

    Raises:
        ImportError: TensorBoard is not installed.
        OSError: a file cannot be written.
        ValueError: a file that is there already is damaged.
    """

    def __init__(self, folder: Path, step: int, tensorboard: bool):
        self._writer: Any = _summary_writer(folder / "tensorboard", step) if tensorboard else None
        self._folder = folder / "logs" / "scalars"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._files: dict[str, IO[str]] = {}
        for file in self._folder.glob("*.csv"):
            _drop_rows_after(step, file)

    def write(self, step: int, numbers: Mapping[str, float]) -> None:
        """Log what was measured at a step."""
        for name, number in numbers.items():
            if name not in self._files:
                self._files[name] = (self._folder / f"{name}.csv").open("a", encoding="utf-8")
            print(step, float(number), sep=",", file=self._files[name], flush=True)
            if self._writer is not None:
                self._writer.add_scalar(name, number, step)

    def close(self) -> None:
        """Close all files."""
        for file in self._files.values():
            file.close()
        if self._writer is not None:
            self._writer.close()


def _drop_rows_after(step: int, file: Path) -> None:
    """Rewrite a CSV file without the rows of later steps and without a last row that was cut off."""
    try:
        text = read_file(file).decode("utf-8")
        rows = [row for row in text.splitlines(keepends=True) if row.endswith("\n")]
        kept = "".join(row for row in rows if int(row.partition(",")[0]) <= step)
    except ValueError as error:
        raise ValueError(f"{file}: damaged, move it away to continue the run ({error})") from error
    if kept != text:
        with atomic_write(file) as temporary:
            temporary.write_text(kept, encoding="utf-8")


def _summary_writer(folder: Path, step: int) -> Any:
    """TensorBoard's writer; TensorBoard hides the events of later steps that are there already."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ImportError(f"TensorBoard cannot be imported ({error}): install it, or add --no-tensorboard") from error
    return SummaryWriter(str(folder), purge_step=step + 1 if step else None)

"""``metrics.csv``: a row per logged step, on disk when the step ends, and without gaps or repeats after a resume."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers.logger import Logger, rank_zero_experiment
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from vpd_lightning.files import AtomicPath

FILE_NAME = "metrics.csv"


class MetricsCSV(Logger):
    """Writes ``metrics.csv`` into a folder; ``step`` counts the updates done.

    Lightning's own CSV logger deletes what it finds when a run goes on in its folder. This one appends, after
    ``rewind`` has removed the rows that the resumed run will write again.
    """

    def __init__(self, *, folder: str | Path) -> None:
        super().__init__()
        self.path = Path(folder) / FILE_NAME
        self._columns: list[str] | None = None

    @property
    def name(self) -> str:
        """Nothing: the file lies directly in the run folder."""
        return ""

    @property
    def version(self) -> str:
        """Nothing: the file lies directly in the run folder."""
        return ""

    @property
    def log_dir(self) -> str:
        return str(self.path.parent)

    @property
    @rank_zero_experiment
    def experiment(self) -> Path:
        """The file."""
        return self.path

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """The run folder holds the configuration in a file of its own."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Append a row; a new metric adds a column."""
        row = {"step": str(int(step or 0)), **{name: repr(float(value)) for name, value in metrics.items()}}
        if self._columns is None:
            self._columns = self._read()[0]
        new = [name for name in row if name not in self._columns]
        if new:
            columns, rows = self._read()
            self._write([*(columns or ["step"]), *(name for name in new if name != "step")], rows)
        assert self._columns is not None
        with self.path.open("a", newline="") as stream:
            csv.DictWriter(stream, self._columns, restval="", lineterminator="\n").writerow(row)

    @rank_zero_only
    def rewind(self, step: int) -> None:
        """Remove the rows of later steps (and a row that a crash cut short)."""
        columns, rows = self._read()
        kept = [row for row in rows if row.get("step", "").isdigit() and int(row["step"]) <= step]
        if columns and len(kept) < len(rows) or not _ends_whole(self.path):
            self._write(columns, kept)

    def _read(self) -> tuple[list[str], list[dict[str, str]]]:
        if not self.path.is_file():
            return [], []
        with self.path.open(newline="") as stream:
            lines = list(csv.reader(stream))
        if not lines:
            return [], []
        columns = lines[0]
        return columns, [dict(zip(columns, line, strict=True)) for line in lines[1:] if len(line) == len(columns)]

    def _write(self, columns: list[str], rows: list[dict[str, str]]) -> None:
        """Replace the file in one move."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with AtomicPath(self.path) as partial, partial.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        self._columns = columns


def _ends_whole(path: Path) -> bool:
    return not path.is_file() or path.read_bytes()[-1:] in (b"\n", b"")

"""``metrics.csv``: appended, extended, rewound."""

import csv
from pathlib import Path

from vpd_lightning.training.metrics_csv import MetricsCSV


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_numbers_are_written_exactly_when_they_are_logged(tmp_path: Path) -> None:
    logger = MetricsCSV(folder=tmp_path / "run")
    logger.log_metrics({"loss": 0.1}, step=1)
    assert rows(logger.path) == [{"step": "1", "loss": "0.1"}]
    logger.log_metrics({"loss": 1 / 3}, step=2)
    assert float(rows(logger.path)[1]["loss"]) == 1 / 3


def test_a_new_metric_adds_a_column(tmp_path: Path) -> None:
    logger = MetricsCSV(folder=tmp_path)
    logger.log_metrics({"loss": 1.0}, step=1)
    logger.log_metrics({"validation/psnr": 20.0}, step=1)
    logger.log_metrics({"loss": 2.0, "validation/psnr": 21.0}, step=2)
    assert rows(logger.path) == [
        {"step": "1", "loss": "1.0", "validation/psnr": ""},
        {"step": "1", "loss": "", "validation/psnr": "20.0"},
        {"step": "2", "loss": "2.0", "validation/psnr": "21.0"},
    ]


def test_a_resumed_run_appends_after_the_rows_up_to_its_checkpoint(tmp_path: Path) -> None:
    first = MetricsCSV(folder=tmp_path)
    for step in range(1, 8):
        first.log_metrics({"loss": float(step)}, step=step)
    second = MetricsCSV(folder=tmp_path)
    second.rewind(5)
    second.log_metrics({"loss": 60.0}, step=6)
    assert [(row["step"], row["loss"]) for row in rows(second.path)] == [
        ("1", "1.0"), ("2", "2.0"), ("3", "3.0"), ("4", "4.0"), ("5", "5.0"), ("6", "60.0")
    ]  # fmt: skip


def test_a_row_that_a_crash_cut_short_is_removed(tmp_path: Path) -> None:
    logger = MetricsCSV(folder=tmp_path)
    logger.log_metrics({"loss": 1.0, "psnr": 2.0}, step=1)
    whole = logger.path.read_text()
    for torn in ("2", "2,0.5", "2,0.5,1"):
        logger.path.write_text(whole + torn)
        again = MetricsCSV(folder=tmp_path)
        again.rewind(1)
        assert again.path.read_text() == whole


def test_rewinding_a_run_without_metrics_does_nothing(tmp_path: Path) -> None:
    MetricsCSV(folder=tmp_path).rewind(3)
    assert list(tmp_path.iterdir()) == []

"""Write a whole report into a folder."""

from collections.abc import Sequence
from pathlib import Path

from vpd_lightning.comparison.collect import Collection
from vpd_lightning.comparison.comparison_table import Board, boards_of
from vpd_lightning.comparison.comparison_video import write_films
from vpd_lightning.comparison.kept_rollouts import kept_rollouts
from vpd_lightning.comparison.page import BoardFiles, page
from vpd_lightning.comparison.plots import overview_plot, rollout_plot, settings_plot, sweep_plot
from vpd_lightning.comparison.rollout_grid import write_strips
from vpd_lightning.comparison.spreadsheet import write_spreadsheet
from vpd_lightning.comparison.sweep import sweeps_of
from vpd_lightning.comparison.warnings import board_warnings, parted_experiments
from vpd_lightning.errors import ConfigError
from vpd_lightning.files import AtomicPath


def write_report(folder: Path, collection: Collection, title: str) -> list[str]:
    """Write ``report.md``, ``report.csv``, plots, strips, films into an existing ``folder``; returns the warnings."""
    boards = boards_of(collection.runs)
    files = [_pictures(folder, board) for board in boards]
    overview = folder / "rollouts.png"
    drawn = len(boards) > 1 and overview_plot(overview, boards)
    text = page(title, boards, files, overview if drawn else None, collection.left_out)
    write_spreadsheet(folder / "report.csv", boards)
    with AtomicPath(folder / "report.md") as partial:
        partial.write_text(text, encoding="utf-8")
    return parted_experiments(boards) + [
        f"{board.title}: {words}" for board in boards for words in board_warnings(board)
    ]


def _pictures(folder: Path, board: Board) -> BoardFiles:
    rollout = folder / f"rollout_{board.file_name}.png"
    drawn = rollout_plot(rollout, board)
    sweeps = []
    for sweep in sweeps_of(board):
        path = folder / f"sweep_{board.file_name}_{sweep.file_name}.png"
        if sweep_plot(path, board, sweep):
            sweeps.append((sweep, path))
    settings = {}
    for system in _with_settings(board):
        path = folder / f"settings_{board.file_name}_{system}.png"
        if settings_plot(path, board, system):
            settings[system] = path
    kept = kept_rollouts(board)
    strips, films, not_shown = write_strips(folder, board, kept), [], list(kept.skipped)
    try:
        films = write_films(folder, board, kept)
    except ConfigError as error:  # this OpenCV has no VP9; the rest of the report does not need it
        not_shown.append((Path("films"), str(error).splitlines()[0]))
    return BoardFiles(rollout if drawn else None, settings, sweeps, strips, films, not_shown)


def _with_settings(board: Board) -> Sequence[str]:
    systems = [row.system for row in board.rows]
    return [system for system in dict.fromkeys(systems) if systems.count(system) > 1]

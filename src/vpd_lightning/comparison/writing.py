"""Write a whole report into a folder."""

from collections.abc import Sequence
from pathlib import Path

from vpd_lightning.comparison.collect import Collection
from vpd_lightning.comparison.comparison_table import ComparisonTable, comparison_tables
from vpd_lightning.comparison.comparison_video import write_films
from vpd_lightning.comparison.kept_rollouts import kept_rollouts
from vpd_lightning.comparison.page import TableFiles, page
from vpd_lightning.comparison.plots import overview_plot, rollout_plot, settings_plot, sweep_plot, time_error_plot
from vpd_lightning.comparison.rollout_grid import write_strips
from vpd_lightning.comparison.spreadsheet import write_spreadsheet
from vpd_lightning.comparison.sweep import sweeps_of
from vpd_lightning.comparison.warnings import parted_experiments, table_warnings
from vpd_lightning.comparison.web_page import web_page
from vpd_lightning.errors import ConfigError
from vpd_lightning.files import AtomicPath


def write_report(folder: Path, collection: Collection, title: str) -> list[str]:
    """Write ``index.html``, ``report.md``, ``report.csv``, plots, strips, films into a ``folder`` that exists.

    Returns the warnings.
    """
    tables = comparison_tables(collection.runs)
    files = [_pictures(folder, table) for table in tables]
    overview = folder / "rollouts.png"
    drawn = len(tables) > 1 and overview_plot(overview, tables)
    text = page(title, tables, files, overview if drawn else None, collection.left_out)
    write_spreadsheet(folder / "report.csv", tables)
    with AtomicPath(folder / "report.md") as partial:
        partial.write_text(text, encoding="utf-8")
    with AtomicPath(folder / "index.html") as partial:
        partial.write_text(web_page(title, text, [path for own in files for path in own.films]), encoding="utf-8")
    return parted_experiments(tables) + [
        f"{table.title}: {words}" for table in tables for words in table_warnings(table)
    ]


def _pictures(folder: Path, table: ComparisonTable) -> TableFiles:
    rollout = folder / f"rollout_{table.file_name}.png"
    drawn = rollout_plot(rollout, table)
    time_error = folder / f"time_error_{table.file_name}.png"
    timed = time_error_plot(time_error, table)
    sweeps = []
    for sweep in sweeps_of(table):
        path = folder / f"sweep_{table.file_name}_{sweep.file_name}.png"
        if sweep_plot(path, table, sweep):
            sweeps.append((sweep, path))
    settings = {}
    for system in _with_settings(table):
        path = folder / f"settings_{table.file_name}_{system}.png"
        if settings_plot(path, table, system):
            settings[system] = path
    kept = kept_rollouts(table)
    strips, films, not_shown = write_strips(folder, table, kept), [], list(kept.skipped)
    try:
        films = write_films(folder, table, kept)
    except ConfigError as error:  # this OpenCV has no VP9; the rest of the report does not need it
        not_shown.append((Path("films"), str(error).splitlines()[0]))
    return TableFiles(
        rollout if drawn else None, time_error if timed else None, settings, sweeps, strips, films, not_shown
    )


def _with_settings(table: ComparisonTable) -> Sequence[str]:
    systems = [row.system for row in table.rows]
    return [system for system in dict.fromkeys(systems) if systems.count(system) > 1]

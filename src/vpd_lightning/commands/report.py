"""``vpd-report``: tables and plots over several runs."""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError

HELP = """vpd-report: tables, plots, strips and films of rollouts over evaluated runs

  vpd-report FOLDER... [out=FOLDER] [title=TEXT] [split=test]
      Finds all run folders below FOLDER... that vpd-eval has evaluated, brings together what can be compared (same
      experiment, same data, same protocol), averages seeds, and writes
        index.html          all of it in a browser, films first
        report.md           tables: systems and references, overview, who is best, paired differences, settings;
                            warnings about what the rows of a table do not share
        report.csv          one row per run: all means, intervals and settings
        rollout*.png        scores over the predicted step; sweep*.png, settings*.png: over what was swept
        strips_*.png        the same rollouts as every system predicted them; film_*.webm: the same, moving
      out       a folder that does not exist; default: FOLDER/report, or runs/report/<time> for several folders
      title     the heading of report.md
      split     of which split the evaluations count: test, or validation while tuning
      Runs that cannot be used are named in report.md with the reason; nothing is trained or evaluated.

Examples
  vpd-report runs/mujoco_block
  vpd-report runs/sweeps/table2 runs/sweeps/sparsity out=runs/report/paper "title=All systems"
  vpd-report runs/mujoco_block split=validation

Exit codes: 0 ok, 2 wrong arguments, 3 no run that can be reported, 130 Ctrl-C, 143 SIGTERM.
debug=true adds the traceback to an error.
"""
_SETTINGS = ("out", "title", "split", "debug")
_SPLITS = ("test", "validation", "train")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    if not words or any(word in ("-h", "--help", "help", "help=true") for word in words):
        print(HELP)
        return 0 if words else ConfigError.exit_code
    folders, settings = _parse(words)
    split = settings.get("split", "test")
    if split not in _SPLITS:
        raise ConfigError(f"split={split} does not exist.\nAllowed: {', '.join(_SPLITS)}.")
    from vpd_lightning.comparison.collect import collect
    from vpd_lightning.comparison.writing import write_report
    from vpd_lightning.files import OutputFolder, choose_folder

    default = (
        folders[0] / "report" if len(folders) == 1 else Path("runs/report") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    )
    out = choose_folder(settings.get("out"), default)
    collection = collect(folders, split)
    with OutputFolder(out) as partial:
        warnings = write_report(partial, collection, settings.get("title", "Report"))
    for warning in warnings:
        print(f"warning: {warning}")
    count = len(collection.runs)
    print(f"{count} run{'s' * (count > 1)} reported, {len(collection.left_out)} left out")
    print(out / "report.md")
    return 0


def _parse(words: Sequence[str]) -> tuple[list[Path], dict[str, str]]:
    """Split arguments into folders and ``key=value`` settings; a word that is a folder is one, whatever its name."""
    folders: list[Path] = []
    settings: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if Path(word).expanduser().is_dir() or not equals:
            if word.startswith("-"):
                raise ConfigError(f"Unknown option {word!r}. Settings are written key=value; see vpd-report --help.")
            folders.append(Path(word).expanduser())
        elif key not in _SETTINGS:
            raise ConfigError(f"There is no setting {key!r}.\nAllowed: {', '.join(_SETTINGS)}. See vpd-report --help.")
        elif key in settings:
            raise ConfigError(f"{key} is given twice.")
        elif not value:
            raise ConfigError(f"{key}= has no value. See vpd-report --help.")
        else:
            settings[key] = value
    if not folders:
        raise ConfigError("No folder is given.\nFor example: vpd-report runs/mujoco_block")
    return folders, settings


if __name__ == "__main__":
    sys.exit(main())

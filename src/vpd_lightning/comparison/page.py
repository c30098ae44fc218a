"""``report.md``: what stands where."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vpd_lightning.comparison.comparison_table import Board
from vpd_lightning.comparison.measure import BY_NAME
from vpd_lightning.comparison.sweep import Sweep
from vpd_lightning.comparison.tables import (
    differences_table,
    overview,
    settings_lists,
    settings_table,
    systems_table,
    winners,
)
from vpd_lightning.comparison.warnings import board_warnings, parted_experiments

_OVERVIEWS = ("psnr", "ssim", "psnr_moving")
_READING = """\
## How to read the tables

- A score is the mean over all images of all held-out clips (`metrics.json`), then over the seeds. In brackets: its 95 %
  bootstrap interval. Each of the {bootstrap} resamples draws trajectories with replacement, the same for all systems,
  and seeds with replacement. With one seed it says nothing about other seeds; with two or three it understates them.
- **Bold**: the best system, whose interval no other one reaches. `~`: the best and those whose interval overlaps its
  interval ("within the interval"); none where training budgets differ. Paired differences, of the steps that both
  predict, can tell systems apart that intervals cannot.
- Sharpness ratio: 1 is as sharp as the truth; where most of a picture does not move, the background dominates it.
  Rigidity error and deepest particle are small also where nothing moves: read them beside the centroid error.
- Budget: what a training was allowed; minutes: what it took, by the named clock; both with its pretraining. Steps:
  updates behind the evaluated weights, without those of a pretraining.
- `-`: not known, or the system has no such thing."""


@dataclass(frozen=True)
class BoardFiles:
    """The pictures of one board, by what they show; ``not_shown`` names rollouts that are missing, and why."""

    rollout: Path | None
    settings: Mapping[str, Path]
    sweeps: Sequence[tuple[Sweep, Path]]
    strips: Sequence[Path]
    films: Sequence[Path]
    not_shown: Sequence[tuple[Path, str]]


def page(
    title: str,
    boards: Sequence[Board],
    files: Sequence[BoardFiles],
    overview_picture: Path | None,
    left_out: Sequence[tuple[Path, str]],
) -> str:
    """Put the report together; pictures lie in the same folder."""
    num_runs = sum(len(board.runs) for board in boards)
    lines = [
        f"# {title}",
        "",
        f"{num_runs} run{'s' * (num_runs > 1)}, {len(left_out)} left out (listed at the end).",
        "",
    ]
    warnings = parted_experiments(boards)
    warnings += [f"{board.title}: {words}" for board in boards for words in board_warnings(board)]
    if warnings:
        lines += ["## Warnings", "", *(f"- {words}" for words in warnings), ""]
    lines += [_READING.format(bootstrap=max(board.runs[0].num_bootstrap for board in boards)), "", "## Overview", ""]
    for name in _OVERVIEWS:
        if any(row.estimate(name) for board in boards for row in board.main_rows):
            lines += [*overview(boards, BY_NAME[name]), ""]
    lines += [f"- {board.title}: {row.name} stands for {row.system}." for board in boards for row in board.main_rows
              if row.name != row.system]  # fmt: skip
    lines += ["", _picture("PSNR over the rollout", overview_picture), ""] if overview_picture else [""]
    for board, own in zip(boards, files, strict=True):
        lines += _board(board, own)
    lines += ["## Runs", "", *_runs(boards), "", "## Left out, and why", ""]
    lines += [f"- `{path}`: {why}" for path, why in left_out] or ["Nothing."]
    return "\n".join(_without_double_blanks(lines)) + "\n"


def _board(board: Board, files: BoardFiles) -> list[str]:
    protocol = board.runs[0].metrics["protocol"]
    facts = [
        f"{protocol[key]} {words}"
        for key, words in (
            ("num_trajectories", "held-out trajectories"),
            ("num_clips", "clips"),
            ("num_steps", "predicted steps"),
            ("num_views", "cameras"),
        )
        if protocol.get(key) is not None
    ]
    starts = protocol.get("start_frames")
    lines = [f"## {board.title}", "", f"{', '.join(facts)}; split {protocol.get('split')}, first frames {starts}; "
             f"data `{board.data_sha256[:12]}`.", ""]  # fmt: skip
    lines += [*(f"- **Warning:** {words}" for words in board_warnings(board)), "", *systems_table(board), ""]
    lines += _machines(board)
    followed = _true_depths(board)
    if followed:
        lines += [
            f"Deepest particle (cm) where they follow the true motion, since cameras put them there: {followed}.",
            "",
        ]
    if files.rollout:
        lines += [_picture("scores over the rollout", files.rollout), ""]
    best = winners(board)
    if best:
        lines += ["### Who is best", "", *best, ""]
    paired = differences_table(board)
    if paired:
        words = "Mean differences on the same trajectories, with their intervals; one that holds 0 tells nothing apart."
        lines += ["### Paired differences", "", words, "", *paired, ""]
    settings = settings_table(board)
    if settings:
        lines += ["### Settings", "", *settings, "", "All that differs:", "", *settings_lists(board), ""]
    for sweep, path in files.sweeps:
        lines += [_picture(f"scores over {sweep.title}", path), ""]
        lines += [f"Not drawn: {row.name}, whose data set is not there to count." for row in sweep.not_placed]
    for system, path in files.settings.items():
        lines += ["", _picture(f"settings of {system} over the rollout", path)]
    if files.strips:
        lines += [
            "",
            "### Rollouts",
            "",
            *(_picture(path.stem.replace("_", " "), path) + "\n" for path in files.strips),
            *(f"- [{path.stem.replace('_', ' ')}]({path.name})" for path in files.films),
        ]
    lines += [f"- not shown: `{path}` ({why})" for path, why in files.not_shown]
    return [*lines, ""]


def _machines(board: Board) -> list[str]:
    known = list(dict.fromkeys(run.machine for row in board.main_rows for run in row.runs if run.machine is not None))
    budgets = list(dict.fromkeys(run.declared_budget for row in board.main_rows for run in row.runs))
    return [f"Budget: {' and '.join(budgets)}; trained on {' and on '.join(known)}.", ""] if known else []


def _true_depths(board: Board) -> str:
    measure, found = BY_NAME["penetration"], []
    for row in board.main_rows:
        depths = [(run.metrics.get("penetration") or {}).get("true_motion") for run in row.runs]
        known = [depth for depth in depths if depth is not None]
        if known:
            found.append(f"{row.name} {measure.shown(sum(known) / len(known))}")
    return ", ".join(found)


def _runs(boards: Sequence[Board]) -> list[str]:
    return [
        f"- {board.title}, {row.name}, seed {run.seed}: `{run.evaluation}`"
        for board in boards
        for row in board.rows
        for run in row.runs
    ]


def _picture(words: str, path: Path) -> str:
    return f"![{words}]({path.name})"


def _without_double_blanks(lines: Sequence[str]) -> list[str]:
    return [line for i, line in enumerate(lines) if line or (i > 0 and lines[i - 1])]

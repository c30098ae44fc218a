"""Tables of ``docs/results`` and ``released`` for the pages; each takes what a file holds and where it lies."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from vpd_lightning.metrics.registry import metric
from vpd_lightning.release.model_card import num_processes

STEPS = tuple(f"step {step}" for step in (1, 4, 8, 16, 32))
FORMS = {
    "updates": ".0f", "s an update": ".2f", "PSNR": ".2f", "PSNR moving": ".2f", "SSIM": ".3f", "size 32": ".2f",
    "rest": ".0%",
}  # fmt: skip
# Runs whose graph network had hardly learned, so that nothing can be held against them: docs/notes.md.
UNLEARNED = ("inertial_gnn", "gnn", "gnn_motion_loss", "gnn_velocity", "gnn_velocity_motion_loss")
NAMES = {
    "inertial_16_trajectories": "inertial, 16 trajectories",
    "no_first_velocity": "without first velocity (`dynamics.first_velocity=null`)",
    "no_rigidity": "without rigidity (`dynamics.keep_shape=false`)",
    "no_rest": "without rest gate (`dynamics.rest_share=0`)",
    "no_memory": "without carried memory (`dynamics.carry_memory=false`)",
    "pixels_alone": "without motion loss (`loss=pixel`)",
    "base": "as it is",
    "pixel": "motion loss off (`loss=pixel data.load_future=false`)",
    "rays_uniform": "rays drawn evenly (`data.moving_ray_fraction=0`)",
    "ray_margin_0": "half of the rays on moving pixels alone (`data.moving_ray_margin=0`)",
    "average": "averaged weights (`callbacks=weight_averaging`), seed 1",
    "no_colors": "no colours among the features (`color_features=false`)",
    "no_octaves": "no octaves in the background (`renderer.background_frequencies=0`)",
    "fast": "three times the learning rate (`optimizer.lr=6e-3`)",
    "long_clips": "8 steps, batch of 2 (`data.num_steps=8 data.batch_size=2`)",
    "growing_clips": "2 steps, then 4 (`data.num_steps_schedule={0.0:2,0.5:4}`)",
    "noise": "location noise (`scene.location_noise=0.003`)",
    "no_warm_up": "no warm-up (`optimizer.warmup_steps=0`)",
}
SCENES = {
    "demo": "a tossed block",
    "mujoco_block": "a tossed block",
    "deformable_collision": "two soft bodies",
    "movi_a": "rigid bodies",
    "pushing": "pushed bodies",
}


_PAPER = Path(__file__).resolve().parents[1] / "docs" / "results" / "paper_table2.json"


def motion(content: Mapping[str, Any], path: Path) -> str:
    """Systems over seeds on several data sets."""
    return _runs(content, ("updates", "PSNR", "PSNR moving", *STEPS, "Chamfer"))


def ablation(content: Mapping[str, Any], path: Path) -> str:
    """Systems over seeds, with the size and the rest of bodies."""
    return _runs(content, ("updates", "PSNR", "PSNR moving", *STEPS, "Chamfer", "size 32", "rest"))


def recipes(content: Mapping[str, Any], path: Path) -> str:
    """Rows of one experiment that differ in a setting of the training."""
    columns = ("s an update", "PSNR", "PSNR moving", "SSIM", "step 1", "step 4", "step 8", "step 32", "size 32")
    return _runs(content, columns)


def report(content: Mapping[str, Mapping[str, str]], path: Path) -> str:
    """The systems of a report of ``vpd-report`` with 95 % intervals, and both references."""
    columns = ("PSNR (dB)", "PSNR moving (dB)", "SSIM", "sharpness", "Chamfer (cm)", "centroid error (cm)")
    keys = ("psnr", "psnr_moving", "ssim", "sharpness", "chamfer", "centroid_error")
    digits, scales = (2, 2, 3, 2, 0, 0), (1, 1, 1, 1, 100, 100)
    lines = _head(["system", *columns, "updates"], 1)
    rows = {name: (line, "", line["steps"]) for name, line in content.items() if line["system"] != "inertial"}
    first = next(iter(content.values()))
    rows |= {"*last frame*": (first, "copy_last_", ""), "*mean image*": (first, "train_mean_", "")}
    for name, (line, prefix, updates) in rows.items():
        cells = []
        for key, digit, scale in zip(keys, digits, scales, strict=True):
            found = [line.get(f"{prefix}{key}{end}") for end in ("", "_low", "_high")]
            shown = [f"{scale * float(value):.{digit}f}" for value in found if value]
            cells.append(f"{shown[0]} [{shown[1]}, {shown[2]}]" if len(shown) == 3 else "-")
        lines.append(f"| {name} | " + " | ".join([*cells, f"{int(updates):,}" if updates else "-"]) + " |")
    return "\n".join(lines)


def sparsity(content: Mapping[str, Mapping[str, str]], path: Path) -> str:
    """PSNR of all and of moving pixels over the number of training trajectories."""
    counts = sorted({int(line["settings"].rpartition("=")[2]) for line in content.values()})
    lines = _head(["PSNR / PSNR moving (dB)", *map(str, counts)], 1)
    for system in sorted({line["system"] for line in content.values()}):
        found = [content[f"{system} (data.num_trajectories={count})"] for count in counts]
        cells = [f"{float(line['psnr']):.2f} / {float(line['psnr_moving']):.2f}" for line in found]
        lines.append(f"| {system} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def first_velocity(content: Mapping[str, Any], path: Path) -> str:
    """Errors of the measured first velocity, as a share of the true speed."""
    facts = content["facts"]
    lines = _head(["scene", "speed (cm a step)", "point error", "median body", "centre error", "bodies"], 1)
    for scene in [name.partition(",")[0] for name in facts if name.endswith("as it is: bodies")]:
        of = {name.partition(": ")[2]: value for name, value in facts.items() if name.startswith(f"{scene}, as it is")}
        shares = ("point error (share of the speed)", "median body's point error", "centre error (share of the speed)")
        cells = [f"{100 * of['rms speed (m a step)']:.1f}", *(f"{of[name]:.0%}".replace("%", " %") for name in shares)]
        lines.append(f"| {scene} | " + " | ".join([*cells, str(int(of["bodies"]))]) + " |")
    return "\n".join(lines)


def edits(content: Mapping[str, Any], path: Path) -> str:
    """Chamfer distance (m) to the counterfactual, over the last steps, by kind of edit."""
    lines = _head(["edit", "edited rollout", "unedited rollout", "edited is nearer in", "the truth changes by"], 1)
    for edit in sorted({row["edit"] for row in content["rows"]}):
        rows = [row for row in content["rows"] if row["edit"] == edit]
        edited, unedited = ([row[f"last_{kind}"] for row in rows] for kind in ("edited", "unedited"))
        nearer = sum(a < b for a, b in zip(edited, unedited, strict=True))
        cells = [f"{np.mean(edited):.3f}", f"{np.mean(unedited):.3f}", f"{nearer} of {len(rows)}"]
        lines.append(
            f"| {edit} | " + " | ".join([*cells, f"{np.mean([r['truth_changed_by'] for r in rows]):.3f}"]) + " |"
        )
    return "\n".join(lines)


def demo(content: Mapping[str, Any], path: Path) -> str:
    """One evaluation of the demo beside both references."""
    motion, long = content["motion"], content["long_rollout"]
    references = content["references"]
    lines = _head(["", "prediction", "last frame repeated", "training mean"], 1)
    rows = (("PSNR (dB)", "psnr", 2), ("PSNR moving (dB)", "psnr_moving", 2), ("SSIM", "ssim", 3), ("FLIP", "flip", 3))
    for title, name, digits in rows:
        values = (content, references["copy_last"], references["train_mean"])
        lines.append(f"| {title} | " + " | ".join(f"{value[name]['mean']:.{digits}f}" for value in values) + " |")
    lines += ["", *_head(["after", "step 1", "step 4", "step 8"], 1)]
    for title, name in (
        ("centroid error (cm)", "centroid_error"),
        ("... of the best constant displacement", "centroid_error_constant"),
        ("... if nothing moves", "centroid_error_copy"),
    ):
        errors = [100 * motion[name]["per_step"][step - 1] for step in (1, 4, 8)]
        lines.append(f"| {title} | " + " | ".join(f"{error:.1f}" for error in errors) + " |")
    size = long["size_ratio"]
    finite = "finite" if long["finite"] else "**not finite**"
    return "\n".join(lines) + (
        f"\n\nOver {long['num_steps']} steps all {long['num_clips']} rollouts stay {finite}; what does not move drifts "
        f"by {100 * long['floor_drift']['max']:.2f} cm at most, and the block keeps its size ({size['min']:.2f} to "
        f"{size['max']:.2f} of that at the start)."
    )


def vpd_motion(content: Mapping[str, Any], path: Path) -> str:
    """Seeds of VPD on one data set: centroid errors beside what needs no learning, then pictures and size."""
    steps = (1, 4, 8, 16, 32)
    lines = _head(["centroid error (cm) after", *map(str, steps)], 1)
    for name, row in content.items():
        lines.append(
            f"| {name} | " + _line(f"{row['centroid_error']['model'][str(step)]['mean']:.1f}" for step in steps)
        )
        for reference, title in {"nothing_moves": "nothing moves", "best_constant": "the best constant"}.items():
            found = [row["difference"][reference][str(step)] for step in steps]
            cells = [f"{one['mean']:.1f} [{one['ci95'][0]:.1f}, {one['ci95'][1]:.1f}]" for one in found]
            lines.append(f"| {name}, less {title} | " + _line(cells))
    first = next(iter(content.values()))["centroid_error"]
    for name in ("nothing_moves", "best_constant", "constant_velocity"):
        cells = [f"{first[name][str(step)]['mean']:.1f}" for step in steps]
        lines.append(f"| *{name.replace('_', ' ')}* | " + _line(cells))
    pictures = ("psnr", "psnr_moving", "ssim")
    titles = ["", "PSNR (dB)", "PSNR moving (dB)", "SSIM", "Chamfer (cm)", "size after 32 steps", "updates"]
    lines += ["", *_head(titles, 1)]
    for name, row in content.items():
        cells = [f"{row[key]['model']:.{2 + (key == 'ssim')}f}" for key in pictures]
        size = row["size_ratio"]["32"]["mean"]  # soft bodies have none
        cells += [f"{100 * row['chamfer']:.1f}", "-" if size is None else f"{size:.2f}", f"{row['updates']:,}"]
        lines.append(f"| {name} | " + _line(cells))
    for name, title in {"copy_last": "*last frame*", "train_mean": "*mean image*"}.items():
        cells = [f"{row[key][name]:.{2 + (key == 'ssim')}f}" for key in pictures]
        lines.append(f"| {title} | " + _line([*cells, "", "", ""]))
    return "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return " | ".join(cells) + " |"


def releases(content: None, path: Path) -> str:
    """One row for each released model in the folder, beside the better reference and what the paper printed."""
    printed = json.loads(_PAPER.read_text())
    titles = ["PSNR (dB)", "better reference", "the paper's VPD", "SSIM", "better reference", "the paper's VPD"]
    lines = _head(["model", "data", "trained for", *titles, "PSNR of moving pixels (dB)", "better reference"], 3)
    found = [
        json.loads(file.read_text()) | {"folder": file.parent.name} for file in sorted(path.glob("*/metrics.json"))
    ]
    for metrics in sorted(found, key=lambda item: (item["experiment"] != "demo", -item["psnr_moving"]["mean"])):
        folder, training, experiment = metrics["folder"], metrics["training"], metrics["experiment"]
        minutes = training["minutes_allowed"]
        config = yaml.safe_load((path / folder / "config.yaml").read_text())
        num_cores = num_processes(config)
        cores = "one core" if num_cores == 1 else f"each of {num_cores} cores"
        length = f"{minutes} minutes of {cores}" if minutes else f"{training['steps']:,} updates"
        before = (config.get("pretraining") or {}).get("ckpt")
        length += f", on from {Path(before).name}" if before else ""
        cells = [
            f"[{folder}](released/{folder})",
            f"{SCENES[experiment]}, {metrics['protocol']['num_steps']} steps",
            length,
        ]
        for score in ("psnr", "ssim", "psnr_moving"):
            digits = metric(score).digits
            better = max(item[score]["mean"] for item in metrics["references"].values())
            cells += [f"{value:.{digits}f}" for value in (metrics[score]["mean"], better)]
            if score in printed:
                known = printed[score].get(experiment)
                cells.append("-" if known is None else f"{known:.{digits}f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def promises(content: Mapping[str, Any], path: Path) -> str:
    """What the reliability checks tried, and how often each promise held."""
    lines = ["| check | promise | held | seen |", "|---|---|---:|---|"]
    for check, found in content.items():
        for index, outcome in enumerate(found["outcomes"]):
            name = f"`{check}` ({found['seconds']} s)" if index == 0 else ""
            held = f"{outcome['held']:,} of {outcome['tried']:,}"
            if not outcome["tried"] or outcome["held"] != outcome["tried"]:
                held = f"**{held}**"
            lines.append(f"| {name} | {outcome['promise']} | {held} | {outcome['seen']} |")
    return "\n".join(lines)


def _runs(content: Mapping[str, Any], columns: Sequence[str]) -> str:
    """Means over seeds with the least and the greatest, and what needs no learning."""
    lines = _head(["data set", "system", "seeds", *columns], 2)
    for experiment, systems in content.items():
        for system, seeds in systems.items():
            if system in (*UNLEARNED, "references"):
                continue
            cells = [_spread([_cell(numbers, name) for numbers in seeds.values()], name) for name in columns]
            lines.append(f"| {experiment} | {NAMES.get(system, system)} | {len(seeds)} | " + " | ".join(cells) + " |")
        for name, numbers in systems["references"].items():
            cells = [_spread([numbers[key]], key) if key in numbers else "" for key in columns]
            lines.append(f"| | {name} | | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(numbers: Mapping[str, float | None], name: str) -> float | None:
    return numbers.get("seconds" if name == "s an update" else name)


def _spread(values: Sequence[float | None], name: str) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    form = FORMS.get(name, ".1f")
    mean = format(float(np.mean(known)), form)
    return mean if len(known) == 1 else f"{mean} [{format(min(known), form)}, {format(max(known), form)}]"


def _head(titles: Sequence[str], num_words: int) -> list[str]:
    """Titles and alignment: the first ``num_words`` columns hold words, the others numbers."""
    words = "---|" * num_words + "---:|" * (len(titles) - num_words)
    return ["| " + " | ".join(titles) + " |", "|" + words]

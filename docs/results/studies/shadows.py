"""Whether shadows leave where a body leaves and arrive where it goes.

Usage: ``python -m docs.results.studies.shadows MODEL --data FOLDER --out OUT.json --starts 0 2 --steps 8``.

Counted are pixels of all cameras that show no body, neither in the last input frame nor in the predicted one, and
whose true brightness (mean of the channels) changes between the two by ``--levels`` of 255 or more: where it falls, a
shadow arrives, where it rises, one leaves. The figure is the predicted change, summed over these pixels, over the true
one: 1 is right, 0 is a shadow that stays or never comes. It is given for the model's own motion, and for its particles
moved truly and drawn by its renderer, which leaves errors of motion out. Intervals are over trajectories.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.drawn_references import drawn_references
from vpd_lightning.evaluation.images import as_float
from vpd_lightning.evaluation.prediction import encode_clip, render_steps
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import load_model
from vpd_lightning.metrics.registry import TRUE_MOTION

SIDES = {"arriving": -1, "leaving": 1}
_NUM_BOOTSTRAP = 1000


def changes(pred: torch.Tensor, clip: Clip, levels: float) -> NDArray[np.float64]:
    """Return sums over the pixels that count, axes ``side 3``: predicted change, true change (levels), pixels.

    ``pred`` (``step view height width 3``) are colours in [0, 1] of all cameras of the clip.
    """
    assert clip.state is not None
    segmentation = torch.from_numpy(clip.state.segmentation)
    now = clip.current_frame
    later = segmentation[now + 1 : now + 1 + pred.shape[0]]
    static = (later == 0) & (segmentation[now] == 0)
    last = as_float(clip.rgb[-1])
    true = 255 * (as_float(clip.target_rgb) - last).mean(-1)
    found = 255 * (pred.clamp(0, 1) - last).mean(-1)
    sums = []
    for sign in SIDES.values():
        counted = static & (sign * true >= levels)
        sums.append([float(found[counted].sum()), float(true[counted].sum()), int(counted.sum())])
    return np.array(sums)


def ratios(sums: NDArray[np.float64]) -> dict[str, dict[str, float | list[float] | int | None]]:
    """Summarise sums by trajectory (``trajectory side 3``)."""
    generator = np.random.default_rng(0)
    draws = generator.integers(0, len(sums), (_NUM_BOOTSTRAP, len(sums)))
    result: dict[str, dict[str, float | list[float] | int | None]] = {}
    for index, side in enumerate(SIDES):
        found, true, count = sums[:, index].T
        if not count.sum():
            result[side] = {"ratio": None, "ci95": None, "true_levels": None, "pixels": 0}
            continue
        drawn = found[draws].sum(1) / np.where(true[draws].sum(1) == 0, np.nan, true[draws].sum(1))
        result[side] = {
            "ratio": float(found.sum() / true.sum()),
            "ci95": [float(value) for value in np.nanpercentile(drawn, [2.5, 97.5])],
            "true_levels": float(true.sum() / count.sum()),
            "pixels": int(count.sum()),
        }
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the figures of a model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--starts", type=int, nargs="+", default=[4])
    parser.add_argument("--steps", type=int, default=32)
    parser.add_argument("--trajectories", type=int, default=16)
    parser.add_argument("--levels", type=float, default=20.0)
    options = parser.parse_args(arguments)
    model = load_model(options.model)
    simulator, views = model.simulator, model.input_views
    paths = load_manifest(options.data).split(options.split)[: options.trajectories]
    sums: dict[str, list[NDArray[np.float64]]] = {"predicted": [], TRUE_MOTION: []}
    for number, path in enumerate(paths):
        of_path = {name: np.zeros((len(SIDES), 3)) for name in sums}
        for start in options.starts:
            clip = read_clip(path, number, start, options.steps)
            scene = encode_clip(simulator, clip, views)
            states = simulator.rollout(scene, options.steps)
            pictures = {
                "predicted": render_steps(simulator, states, clip.target_cameras).float().cpu(),
                TRUE_MOTION: drawn_references(simulator, scene, clip, 0.02)[TRUE_MOTION],
            }
            for name, pred in pictures.items():
                of_path[name] += changes(pred, clip, options.levels)
        for name, values in of_path.items():
            sums[name].append(values)
    content = {
        "model": options.model,
        "data": options.data.name,
        "split": options.split,
        "num_trajectories": len(paths),
        "starts": options.starts,
        "num_steps": options.steps,
        "levels": options.levels,
        **{name: ratios(np.stack(values)) for name, values in sums.items()},
    }
    with AtomicPath(options.out) as part:
        part.write_text(json.dumps(content, indent=1) + "\n")
    for name in sums:
        for side in SIDES:
            print(f"{name:12} {side:9} {content[name][side]}")  # type: ignore[index]
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

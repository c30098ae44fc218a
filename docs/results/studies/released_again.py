"""Whether today's code gives each released model the figures of its card.

``python -m docs.results.studies.released_again OUT.json WORK [--models NAME,...]`` generates the test trajectories that
a model's configuration names (``WORK/SCENE_PRESET``; a training and a validation trajectory beside them, which no
figure of the model depends on), evaluates the model by the protocol of its ``metrics.json`` and writes both figures
side by side. A model that stands in the file already, with the same weights, is not evaluated again. The exit code is 1
where a figure lies farther from the card's than ``LIMITS``.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from vpd_lightning.files import AtomicPath

RELEASED = Path("released")
LIMITS = {"psnr": 0.02, "psnr_moving": 0.02, "ssim": 0.002, "centroid_error_cm": 0.1}
"""Largest differences to the card: decibels, decibels, none, centimetres."""

_NOT_SETTINGS = ("input_views", "num_views", "num_clips", "draw_references")


def figures(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the figures of a ``metrics.json`` that are compared; the centroid error is the mean over all steps."""
    found = {name: metrics[name]["mean"] for name in ("psnr", "psnr_moving", "ssim")}
    motion = metrics["motion"] or {}
    if "centroid_error" in motion:
        found["centroid_error_cm"] = 100 * motion["centroid_error"]["mean"]
    return found


def compared(card: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of two evaluations of a model, and which differ by more than ``LIMITS``."""
    before, after = figures(card), figures(now)
    gone = before.keys() ^ after.keys()
    apart = [name for name in before.keys() & after.keys() if not abs(after[name] - before[name]) <= LIMITS[name]]
    return {
        "card": before,
        "now": after,
        "apart": sorted([*gone, *apart]),
        "num_clips": now["protocol"]["num_clips"],
        "same_clips": now["protocol"]["num_clips"] == card["protocol"]["num_clips"],
    }


def evaluated(model: Path, work: Path) -> dict[str, Any]:
    """Generate the test trajectories where they are missing, and return the ``metrics.json`` of today's evaluation."""
    config = yaml.safe_load((model / "config.yaml").read_text())
    protocol = json.loads((model / "metrics.json").read_text())["protocol"]
    made = config["generate"]
    data = work / f"{made['scene']}_{made['preset']}"
    sizes = ("splits.train=1", "splits.validation=1", f"splits.test={protocol['num_trajectories']}")
    named = [f"{name}={made[name]}" for name in ("scene", "preset", "seed")]
    _call("data", "generate", *named, *sizes, f"out={data}")
    out = work / f"evaluation_{model.name}"
    words = [
        f"protocol.{name}={json.dumps(value).replace(' ', '')}"
        for name, value in protocol.items()
        if name not in _NOT_SETTINGS
    ]
    if not (out / "metrics.json").is_file():
        _call("eval", f"ckpt={model}", f"data.folder={data}", f"out={out}", "num_videos=0", "num_threads=1", *words)
    return json.loads((out / "metrics.json").read_text())  # type: ignore[no-any-return]


def _call(command: str, *words: str) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-m", f"vpd_lightning.commands.{command}", *words], check=True, env=environment)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the models that are asked for with their cards."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--models", type=lambda text: text.split(","), help="all that are released, if not given")
    options = parser.parse_args(arguments)
    models = [RELEASED / name for name in options.models or sorted(path.name for path in RELEASED.iterdir())]
    known = json.loads(options.out.read_text()) if options.out.is_file() else {}
    for model in models:
        weights = json.loads((model / "release.json").read_text())["sha256"]["model.safetensors"]
        if known.get(model.name, {}).get("weights") == weights:
            continue
        card = json.loads((model / "metrics.json").read_text())
        known[model.name] = {"weights": weights, **compared(card, evaluated(model, options.work))}
        with AtomicPath(options.out) as part:
            part.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n")
    apart = {name: known[name]["apart"] for name in (model.name for model in models) if known[name]["apart"]}
    print(f"{len(models)} models compared with their cards; farther apart than {LIMITS}: {apart or 'none'}")
    return 1 if apart else 0


if __name__ == "__main__":
    raise SystemExit(main())

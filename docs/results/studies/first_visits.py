"""Time of a training step of ``model=inertial``: when its frames are seen for the first time, and later.

``python -m docs.results.studies.first_visits OUT.json SCENE NAME=FOLDER ... [--batches 6]``. What may move and the
planes fitted to noisy depth are found when a frame is first seen, and remembered. For each data set the same batches
are taken three times, forward and backward; by the mask that takes depth for exact
(``encoder.background.noise_floor=null``) and by the one that looks for noise. One thread; seconds are medians over
batches, and of the two later times the smaller one.
"""

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import LightningDataModule

from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.files import AtomicPath
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.training.module import VPDModule
from vpd_lightning.training.optimization import AbstractOptimization

MASKS = {"depth taken for exact": "encoder.background.noise_floor=null", "noise looked for": ""}


def seconds(scene: str, folder: Path, mask: str, num_batches: int) -> dict[str, float]:
    """Return the median time of a step at its frames' first visit, and at the two later ones."""
    words = (f"experiment={scene}", "model=inertial", "budget=minutes", f"data.folder={folder}", "run.folder=unused")
    config: dict[str, Any] = compose("train", [*words, "seed=0", *([MASKS[mask]] if MASKS[mask] else [])])
    torch.manual_seed(0)
    datamodule = build(config["data"], LightningDataModule, "data")
    datamodule.setup("fit")
    module = VPDModule(
        simulator=build_simulator(config),
        losses=build_list(config["loss"], AbstractLoss, "loss"),
        optimization=build(config["optimizer"], AbstractOptimization, "optimizer"),
        config=config,
    ).train()
    # The first one compiles what is compiled, and is not counted.
    batches = list(itertools.islice(datamodule.loader(max_steps=num_batches + 1), num_batches + 1))
    passes = [[_step(module, batch) for batch in batches[min(number, 1) :]] for number in range(3)]
    later = [min(pair) for pair in zip(passes[1], passes[2], strict=True)]
    return {"first visit": statistics.median(passes[0][1:]), "later": statistics.median(later)}


def _step(module: VPDModule, batch: Any) -> float:
    start = time.process_time()
    _, _, total = module.losses_of(batch)
    total.backward()  # type: ignore[no-untyped-call]
    module.zero_grad(set_to_none=True)
    return time.process_time() - start


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all data sets and write the seconds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scene")
    parser.add_argument("folders", nargs="+", help="NAME=FOLDER")
    parser.add_argument("--batches", type=int, default=6)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name, folder in (word.split("=", 1) for word in options.folders):
        found[name] = {mask: seconds(options.scene, Path(folder), mask, options.batches) for mask in MASKS}
        print(name, json.dumps(found[name]), flush=True)
    with AtomicPath(options.out) as part:
        command = f"python -m docs.results.studies.first_visits {options.scene}"
        part.write_text(json.dumps({"command": command, "processor seconds of a step": found}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""What many motions side by side cost: one batch from one encoded scene, beside single rollouts from the same moment.

``python -m docs.results.studies.candidates OUT.json CKPT DATA [--count 256 --steps 10 --single 16]`` rolls out
``count`` random motions of the tool at once and ``single`` of them one by one from the moment after encoding
(``Simulator.start``), in turn, three times, with the same threads; the least time of each counts. ``ratio`` is that of
``count`` single ones to the batch. ``difference`` is the largest between both results (metres).
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from docs.results.studies.changed_dynamics import add_option, change_dynamics
from vpd_lightning.data.clip import read_clip
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.planning.tool import PlanarTool

TOOL = PlanarTool(0.016, low=(-0.4, -0.35), high=(0.4, 0.35), hold=5)
REPEATS = 3


def measured(model: LoadedModel, data: Path, count: int, steps: int, single: int) -> dict[str, Any]:
    """Return seconds of both, their ratio and the largest difference."""
    simulator = model.simulator
    clip = read_clip(sorted((data / "test").glob("*.h5"))[0], 0, 6, 1)
    with torch.no_grad():
        scene = encode_clip(simulator, clip, model.input_views)
        moment = simulator.start(scene)
        driven = scene.current.driven
        assert driven is not None
        draw = torch.Generator().manual_seed(0)
        actions = 2 * torch.rand(count, -(-steps // TOOL.hold), 2, generator=draw) - 1
        motion = TOOL.motion(driven, actions)[:, :steps]
        together, alone, difference = [], [], 0.0
        for _ in range(REPEATS):
            began = time.perf_counter()
            rollout = moment.branched(count)
            for step in range(steps):
                rollout = rollout.step(motion[:, step : step + 1])
            together.append(time.perf_counter() - began)
            began = time.perf_counter()
            for number in range(single):
                one = moment
                for step in range(steps):
                    one = one.step(motion[number, step : step + 1])
                gap = one.particles.positions[0] - rollout.particles.positions[number]
                difference = max(difference, float(gap.abs().max()))
            alone.append((time.perf_counter() - began) / single)
    return {
        "candidates": count,
        "steps": steps,
        "threads": torch.get_num_threads(),
        "seconds_together": min(together),
        "seconds_of_one": min(alone),
        "ratio": count * min(alone) / min(together),
        "difference": difference,
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("ckpt")
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=256)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--single", type=int, default=16)
    add_option(parser)
    options = parser.parse_args()
    model = load_model(options.ckpt)
    changes = change_dynamics(model, options.dynamics)
    found = {**measured(model, options.data, options.count, options.steps, options.single), "dynamics": changes}
    with AtomicPath(options.out) as path:
        path.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

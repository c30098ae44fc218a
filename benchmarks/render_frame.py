"""One rendered 128x128 frame, by renderer: ``python -m benchmarks.render_frame``.

All renderers see the same particles of the demo's data; weights are untrained, which does not change the work. The
baseline is the volume renderer with the field of ``surface`` and 32 + 32 samples per ray; ``volume`` itself is compared
with its own brute-force search, which must draw the same picture.
"""

import argparse
import tempfile
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measuring import Row, row, seconds_now, write
from benchmarks.plain_path import plain
from benchmarks.workloads import Workload, prepare
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Cameras

SIZE = 128
VOLUME = "volume"
RENDERERS = {
    VOLUME: (
        "renderer=point_nerf_small",
        "renderer.num_neighbors=16",
        "renderer.num_coarse_samples=32",
        "renderer.num_fine_samples=32",
        "renderer.net_width=64",
        "renderer.net_width_condition=32",
    ),
    "point_nerf_small": ("renderer=point_nerf_small",),
    "surface": ("renderer=surface",),
    "splat": ("renderer=splat",),
}
TOLERANCE = 1e-4  # colours in [0, 1]; the same sums in another order


def one_frame(simulator: Simulator, scene: Scene, cameras: Cameras, device: torch.device) -> tuple[Tensor, float]:
    """Render the current particles; return the picture and the seconds it took."""
    start = seconds_now(device)
    picture = simulator.render([scene.current], cameras)
    return picture, seconds_now(device) - start


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    device = torch.device(options.device)

    simulators: dict[str, Simulator] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, words in RENDERERS.items():
            training = prepare(Workload(name, "demo", ("experiment=demo", *words)), Path(scratch), device)
            simulators[name] = training.simulator.eval()
    context = training.batch.context[0]
    scene = simulators[VOLUME].encode(context.rgb, context.depth, context.cameras)
    camera = context.cameras[0][:1]
    zoom = torch.tensor([SIZE / camera.width, SIZE / camera.height, 1.0], device=device)
    camera = Cameras(camera.intrinsics * zoom[:, None], camera.cam_to_world, SIZE, SIZE)

    seconds: dict[str, list[float]] = {name: [] for name in (*RENDERERS, "brute")}
    pictures: dict[str, Tensor] = {}
    for repeat in range(options.repeats + 1):  # the first round warms up
        for name in seconds:
            simulator = simulators[VOLUME if name == "brute" else name]
            with plain(simulator, num_steps=1) if name == "brute" else nullcontext():
                pictures[name], taken = one_frame(simulator, scene, camera, device)
            if repeat:
                seconds[name].append(taken)
    error = float((pictures[VOLUME] - pictures["brute"]).abs().max())
    if not error < TOLERANCE:
        raise AssertionError(f"brute force draws another picture: largest difference {error:.1e}")
    rows: list[Row] = [row(f"frame/{VOLUME}", seconds[VOLUME], "brute-force neighbours", seconds["brute"], error)]
    rows += [row(f"frame/{name}", seconds[name], f"frame/{VOLUME}", seconds[VOLUME]) for name in list(RENDERERS)[1:]]
    write("render_frame", device, rows)


if __name__ == "__main__":
    main()

"""Models trained for the same time on the same data: quality on the same test pixels, and time per frame.

``python -m benchmarks.equal_time runs/bench/surface runs/bench/volume ...`` takes run folders; the first one is the
baseline. How long each was trained is read off its files. Where a run was supervised by some cameras only
(``data.target_views``), the pixels of the others are measured by themselves: nobody was taught what they see.

    vpd-train ... scene.input_views=[0,1,2] data.target_views=[0,1,2] renderer=splat run.folder=runs/novel/splat
    python -m benchmarks.equal_time runs/novel/surface runs/novel/splat --steps 1 --name equal_time_renderers
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measuring import Options, Result, Row, interleaved, row
from benchmarks.models import Model, load_models
from benchmarks.plots import Mark, quality_over_time
from benchmarks.results_files import write
from benchmarks.suites.accuracy import view_of
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.types import Rays

SIDE = 128
ALL, SEEN, HELD_OUT = "all cameras", "training cameras", "held-out cameras"


def training_time(folder: Path) -> tuple[float, str]:
    """Return how long a training was, and by which clock.

    A run with a budget of time wrote that down; of others it is the wall time between the configuration, written when
    training starts, and the last checkpoint.
    """
    record = folder / "training_time.json"
    if record.is_file():
        content = json.loads(record.read_text())
        return float(content["seconds"]), str(content["clock"])
    wall = (folder / "checkpoints" / "last.ckpt").stat().st_mtime - (folder / "config.yaml").stat().st_mtime
    return wall, "wall"


def cameras_of(model: Model) -> dict[str, list[int]]:
    """Return the cameras that supervised and those that did not, by their names in the table."""
    every = list(range(model.clip(1).target_rgb.shape[1]))
    taught = model.config["data"].get("target_views")
    if taught is None or set(taught) >= set(every):
        return {ALL: every}
    return {SEEN: sorted(taught), HELD_OUT: [view for view in every if view not in taught]}


def pixels_psnr(model: Model, num_clips: int, num_rays: int, horizons: Sequence[int], cameras: Sequence[int]) -> Tensor:
    """Return the PSNR of random pixels, one value per (clip, predicted step); the pixels depend on the clip alone."""
    device = next(model.simulator.parameters()).device
    values = []
    for clip in range(num_clips):
        view = view_of(model, num_rays, device, horizons, trajectory=clip, cameras=cameras)
        with torch.no_grad():
            colors = model.simulator.renderer(view.particles, view.rays, None).rgbs.clamp(0, 1)
        values.append(-10 * (colors - view.truth).square().mean(dim=(1, 2)).log10())
    return torch.stack(values)


def frame_seconds(model: Model, repeats: int, share: float) -> list[float]:
    """Return the time of 128 x 128 pixels of a test clip; ``share`` of its rays are rendered and the time scaled."""
    device = next(model.simulator.parameters()).device
    clip = model.clip(1)
    view = view_of(model, 1, device, (1,))
    rays = pixel_rays(clip.target_cameras[0][:1].to(device))
    step = round(1 / share)
    some = Rays(*(t.reshape(1, -1, 3)[:, ::step].float() for t in (rays.origins, rays.directions)))
    scale = SIDE**2 / some.origins.shape[1]

    def render() -> None:
        with torch.no_grad():
            model.simulator.renderer(view.particles, some, None)

    return [seconds * scale for seconds in interleaved({"frame": render}, repeats, device)["frame"]]


def measure(folders: Sequence[Path], repeats: int, num_clips: int, num_rays: int, horizons: Sequence[int]) -> Result:
    """Measure all runs; rows hold the time of a frame, the PSNR and, in the note, how long the run was trained."""
    rows: list[Row] = []
    facts: dict[str, float] = {}
    baseline: tuple[str, list[float]] = ("", [])
    psnrs: dict[str, dict[str, Tensor]] = {}
    for folder in folders:
        options = Options(torch.device("cpu"), "full", repeats, [folder / "checkpoints" / "last.ckpt"])
        ((kind, model),) = load_models(options).items()
        name = f"{folder.name} ({kind})"
        samples = model.config["renderer"].get("num_coarse_samples", 0) + model.config["renderer"].get(
            "num_fine_samples", 0
        )
        seconds = frame_seconds(model, repeats, 1 / 64 if samples > 200 else 1.0)
        baseline = baseline if baseline[1] else (name, seconds)
        trained, clock = training_time(folder)
        note = f"{num_clips} test clips, steps {list(horizons)}; trained {trained:.0f} s ({clock}), {model.step} steps"
        facts[f"{name}: seconds trained"] = round(trained)
        for cameras, views in cameras_of(model).items():
            found = pixels_psnr(model, num_clips, num_rays, horizons, views)
            psnrs.setdefault(cameras, {})[name] = found
            full = f"equal_time/{name}" if cameras == ALL else f"equal_time/{name}, {cameras}"
            rows.append(row(full, seconds, baseline[0], baseline[1], psnr=float(found.mean()), note=note))
            facts[f"standard error of {name}, {cameras} (dB)"] = _standard_error(found.mean(dim=1))
    for cameras, found in psnrs.items():
        first, *others = found
        for other in others:
            # Same pixels, so differences clip by clip; clips are what is independent.
            difference = (found[other] - found[first]).mean(dim=1)
            where = "" if cameras == ALL else f", {cameras}"
            facts[f"dB of {other} over {first}{where}"] = float(difference.mean())
            facts[f"its standard error over {num_clips} clips ({other}{where})"] = _standard_error(difference)
    return Result(rows, facts)


def _standard_error(values: Tensor) -> float:
    return float(values.std() / len(values) ** 0.5) if len(values) > 1 else 0.0


def draw(result: Result, path: Path) -> None:
    """Draw PSNR over the time of a frame, one point per run and kind of cameras."""
    marks = []
    for item in result.rows:
        name, _, cameras = item.name.removeprefix("equal_time/").partition(", ")
        spread = result.facts[f"standard error of {name}, {cameras or ALL} (dB)"]
        marks.append(Mark(name.split(" (")[0], cameras or ALL, item.seconds or 0.0, item.psnr or 0.0, spread))
    quality_over_time(marks, f"Trained for equal time; a {SIDE} x {SIDE} frame on one thread", path)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders; the first one is the baseline")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--rays", type=int, default=256, help="pixels per clip and step")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--name", default="equal_time", help="of the result files")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(given.runs, given.repeats, given.clips, given.rays, given.steps)
    path = write(given.name, torch.device("cpu"), result, given.out)
    draw(result, path.with_suffix(".png"))
    print("\n".join(f"{name}: {value}" for name, value in result.facts.items()))
    print(path)


if __name__ == "__main__":
    main()

"""Renderers trained for the same wall time on the same data: quality on the same test pixels, and time per frame.

``python -m benchmarks.equal_time runs/bench/surface runs/bench/volume ...`` takes run folders; the first one is the
baseline. How long each was trained is read off its files: from the configuration, written when training starts, to the
last checkpoint.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measuring import Options, Result, Row, interleaved, row
from benchmarks.models import Model, load_models
from benchmarks.results_files import write
from benchmarks.suites.accuracy import view_of
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.types import Rays

SIDE = 128


def training_seconds(folder: Path) -> float:
    """Return the wall time between the start of a training and its last checkpoint."""
    return (folder / "checkpoints" / "last.ckpt").stat().st_mtime - (folder / "config.yaml").stat().st_mtime


def pixels_psnr(model: Model, num_clips: int, num_rays: int, horizons: Sequence[int]) -> Tensor:
    """Return the PSNR of random pixels, one value per (clip, predicted step); the pixels depend on the clip alone."""
    device = next(model.simulator.parameters()).device
    values = []
    for clip in range(num_clips):
        view = view_of(model, num_rays, device, horizons, trajectory=clip)
        with torch.no_grad():
            colors = model.simulator.renderer(view.particles, view.rays, None).rgbs.clamp(0, 1)
        values.append(-10 * (colors - view.truth).square().mean(dim=(1, 2)).log10())
    return torch.stack(values)


def frame_seconds(model: Model, repeats: int, share: float) -> list[float]:
    """Return the time of one 128x128 frame of a test clip; ``share`` of its rays are rendered and the time scaled."""
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
    facts = {}
    baseline: tuple[str, list[float]] = ("", [])
    psnrs: dict[str, Tensor] = {}
    for folder in folders:
        options = Options(torch.device("cpu"), "full", repeats, [folder / "checkpoints" / "last.ckpt"])
        ((kind, model),) = load_models(options).items()
        name = f"{folder.name} ({kind})"
        psnrs[name] = pixels_psnr(model, num_clips, num_rays, horizons)
        samples = model.config["renderer"].get("num_coarse_samples", 0) + model.config["renderer"].get(
            "num_fine_samples", 0
        )
        seconds = frame_seconds(model, repeats, 1 / 64 if samples > 200 else 1.0)
        baseline = baseline if baseline[1] else (name, seconds)
        trained = training_seconds(folder)
        note = f"{num_clips} test clips, steps {list(horizons)}; trained {trained:.0f} s, {model.step} steps"
        rows.append(
            row(f"equal_time/{name}", seconds, baseline[0], baseline[1], psnr=float(psnrs[name].mean()), note=note)
        )
        facts[f"{name}: seconds trained"] = round(trained)
    first, *others = psnrs
    for other in others:
        # Same pixels, so differences clip by clip; clips are what is independent.
        difference = (psnrs[other] - psnrs[first]).mean(dim=1)
        facts[f"dB of {other} over {first}"] = float(difference.mean())
        facts[f"its standard error over {num_clips} clips ({other})"] = float(difference.std() / num_clips**0.5)
    return Result(rows, facts)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders; the first one is the baseline")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--rays", type=int, default=256, help="pixels per clip and step")
    parser.add_argument("--steps", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    given = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(given.runs, given.repeats, given.clips, given.rays, given.steps)
    path = write("equal_time", torch.device("cpu"), result, given.out)
    print("\n".join(f"{name}: {value}" for name, value in result.facts.items()))
    print(path)


if __name__ == "__main__":
    main()

"""Every model in ``released/`` is whole, small, loads, predicts, and its card tells its figures."""

import json
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from tests.released_model import cameras, synthetic_frames
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.release.card_figures import REFERENCES
from vpd_lightning.release.portable import absolute_paths
from vpd_lightning.release.release_folder import check_release, folder_bytes, is_release
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.system import AbstractSystem
from vpd_lightning.testing.particle_sets import reordered
from vpd_lightning.types import Cameras, RGBDFrames

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = sorted(path for path in (ROOT / "released").glob("*") if path.is_dir())
pytestmark = pytest.mark.skipif(not FOLDERS, reason="nothing is released")
MAX_BYTES = 20_000_000
STEPS = 2
LONG = 40
MOST_PARTICLES = 1024  # of a long rollout
# One model of each system in `make test`, and of ours the one with all of its scenery as well.
FIRST = ("mujoco_block_demo", "deformable_collision_128", "mujoco_block_vpd", "movi_a_sequential")
LONGER = [pytest.param(path, marks=() if path.name in FIRST else pytest.mark.exhaustive) for path in FOLDERS]


@pytest.fixture(params=FOLDERS, ids=lambda path: path.name)
def folder(request: pytest.FixtureRequest) -> Path:
    return request.param


def test_it_is_whole_and_small(folder: Path) -> None:
    assert is_release(folder)
    index = check_release(folder)
    assert index["name"] == folder.name and folder_bytes(folder) <= MAX_BYTES


def test_it_names_no_place_of_a_machine(folder: Path) -> None:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    metrics = json.loads((folder / "metrics.json").read_text())
    assert not absolute_paths(config) and not absolute_paths(metrics)
    assert "/home/" not in (folder / "README.md").read_text()


@cache
def loaded(folder: Path) -> LoadedModel:
    """Return the model, loaded once for all tests; not to be changed."""
    return load_model(folder)


def test_it_predicts(folder: Path) -> None:
    model = loaded(folder)
    past, views = model.simulator.num_context_frames, model.input_views
    size, width = picture_size(model)
    placed, distance = known_cameras(model, size, width)
    seen = placed[:1] if isinstance(model.simulator, Simulator) else placed  # others predict the views they are given
    rgb, depth = synthetic_frames(past, len(views), size=size, width=width, distance=distance)
    frames = model.simulator.predict_frames(RGBDFrames(rgb, depth, over_time(placed, past)), over_time(seen, STEPS))
    assert frames.shape == (STEPS, *seen.shape, size, width, 3)
    assert torch.isfinite(frames).all() and frames.min() >= 0 and frames.max() <= 1
    count = sum(parameter.numel() for parameter in model.simulator.parameters())
    assert count == json.loads((folder / "release.json").read_text())["num_parameters"]


@pytest.mark.parametrize("folder", LONGER, ids=[path.name for path in FOLDERS], indirect=True)
def test_it_says_the_same_in_float64_and_stays_finite(folder: Path) -> None:
    model = loaded(folder)
    past, views = model.simulator.num_context_frames, model.input_views
    size, width = picture_size(model)
    placed, distance = known_cameras(model, size, width)
    rgb, depth = synthetic_frames(past, len(views), size=size, width=width, distance=distance)
    # All cameras stand at one place: on level ground each point would be there once per view, and which of its copies
    # is a neighbour would be a matter of rounding.
    depth = depth * (1 + 0.02 * torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)))
    context = RGBDFrames(rgb, depth, over_time(placed, past))
    seen = placed[:1] if isinstance(model.simulator, Simulator) else placed

    def predict(dtype: torch.dtype) -> torch.Tensor:
        system = deepcopy(model.simulator).to(dtype)
        return system.predict_frames(context.to(dtype), over_time(seen, STEPS).to(dtype)).double()

    # Weights are stored in float32. A neighbour more or less at the rim of a radius changes single pixels, no picture.
    assert (predict(torch.float32) - predict(torch.float64)).abs().mean() < 1e-3
    assert stays_finite(model.simulator, context, seen)


def stays_finite(system: AbstractSystem, context: RGBDFrames, seen: Cameras) -> bool:
    """Whether a long rollout has finite states and pictures.

    What overflows does so for the number of steps, not of particles or pixels: where both can be chosen, they are few.
    """
    if not isinstance(system, Simulator):
        return bool(torch.isfinite(system.predict_frames(context, over_time(seen, LONG))).all())
    scene = system.encode(context.rgb, context.depth, context.cameras)
    every = max(1, scene.current.num_particles // MOST_PARTICLES)
    few = torch.arange(0, scene.current.num_particles, every)
    states = system.rollout(Scene(reordered(scene.previous, few), reordered(scene.current, few)), LONG)
    quarter = torch.tensor([0.25, 0.25, 1.0])[:, None]
    small = Cameras(quarter * seen.intrinsics, seen.cam_to_world, seen.height // 4, seen.width // 4)
    values = [system.render(states, small), *(value for state in states for value in (state.positions, state.features))]
    return all(bool(torch.isfinite(value).all()) for value in values)


def picture_size(model: LoadedModel) -> tuple[int, int]:
    """Height and width of the pictures a model was made for, where it is made for some."""
    background = fitted_background(model)
    if background is not None:
        return background.depth.shape[-2], background.depth.shape[-1]
    encoder = model.config.get("encoder") or {}
    made_for = encoder.get("height"), encoder.get("width")
    return made_for if all(isinstance(size, int) for size in made_for) else (64, 64)


def fitted_background(model: LoadedModel) -> Any:
    """What a model knows of the background of fixed cameras; None for others."""
    background = getattr(getattr(model.simulator, "encoder", None), "background", None)
    return background if background is not None and background.needs_fit else None


def known_cameras(model: LoadedModel, size: int, width: int) -> tuple[Cameras, float]:
    """Cameras for the input views that look at the workspace, and how far from its middle they are (metres).

    A model that knows the background of fixed cameras gets those.
    """
    scene, encoder = model.config["scene"], model.config.get("encoder") or {}
    center = [(low + high) / 2 for low, high in zip(scene["workspace_min"], scene["workspace_max"], strict=True)]
    distance = encoder.get("initial_depth") or (scene["near"] + scene["far"]) / 2
    placed = cameras(len(model.input_views), size=size, width=width, center=center, distance=distance)
    background = fitted_background(model)
    if background is None:
        return placed, distance
    poses = background.cam_to_world[model.input_views]
    away = (poses[:, :3, 3] - torch.tensor(center)).norm(dim=-1).min()
    return replace(placed, cam_to_world=poses), float(away)


def over_time(placed: Cameras, num_frames: int) -> Cameras:
    """The same cameras at every frame."""
    index = torch.zeros(num_frames, dtype=torch.long)
    return placed[None][index]


def test_its_card_tells_its_figures(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text())
    rows = [line.split("|") for line in (folder / "README.md").read_text().splitlines() if line.startswith("| ")]
    cells = {row[1].strip(): [cell.strip() for cell in row[2:]] for row in rows}
    for label, name, digits in (("PSNR (dB)", "psnr", 2), ("SSIM", "ssim", 3)):
        model, interval, *references = cells[label][:4]
        assert model == f"{metrics[name]['mean']:.{digits}f}"
        assert interval == " to ".join(f"{end:.{digits}f}" for end in metrics[name]["ci95"])
        assert references == [f"{metrics['references'][of][name]['mean']:.{digits}f}" for of in REFERENCES]

"""Roll one recording out and film it from chosen cameras; keep the particles, coloured by the renderer."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import AtomicPath
from vpd_lightning.errors import ConfigError
from vpd_lightning.evaluation.clip import encode_clip
from vpd_lightning.evaluation.protocol import Clip, read_cameras, read_clip
from vpd_lightning.export.camera_paths import common_target, read_camera_file, resized, ring_cameras
from vpd_lightning.export.particle_colors import particle_colors
from vpd_lightning.export.particle_files import write_particles, write_ply
from vpd_lightning.export.pictures import write_contact_sheet, write_particle_plot, write_png
from vpd_lightning.export.video import comparison_frames, enlarge, write_video
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras, Particles

PARTICLE_FORMATS = ("ply", "npz")
_MAX_PANELS = 4


@dataclass(frozen=True)
class Viewpoints:
    """Where to film from. ``moving``: ``cameras`` are the places of one camera, one per frame; else each makes a film.

    ``views`` are the numbers of recorded cameras, for comparison with the truth; None for cameras of no recording.
    """

    cameras: Cameras
    moving: bool
    views: list[int] | None
    names: list[str]


def choose_viewpoints(
    camera: str | int | Sequence[int], path: Path, start: int, num_frames: int, input_views: Sequence[int]
) -> Viewpoints:
    """Turn ``input``, ``all``, numbers of recorded cameras, ``ring`` or the name of a JSON file into cameras.

    Raises:
        ConfigError: a word that means nothing, or a camera that the recording lacks.
        DataError: a bad camera file.
    """
    with TrajectoryReader(path) as reader:
        recorded = read_cameras(reader, [start + 1], range(reader.num_views))[0]
        low, high = torch.tensor(reader.workspace_min), torch.tensor(reader.workspace_max)
    if camera == "ring":
        target = common_target(recorded, ((low + high) / 2).float())
        return Viewpoints(ring_cameras(recorded, num_frames, target), True, None, ["ring"])
    if isinstance(camera, str) and camera.endswith(".json"):
        cameras, moving = read_camera_file(Path(camera).expanduser())
        if moving and cameras.shape[0] < num_frames:
            raise ConfigError(
                f"{camera} has {cameras.shape[0]} places of a moving camera; {num_frames} frames are filmed.\n"
                f"Lower num_steps to {cameras.shape[0] - 1}, or add places."
            )
        names = ["path"] if moving else [f"novel_{number:02d}" for number in range(cameras.shape[0])]
        return Viewpoints(cameras[:num_frames] if moving else cameras, moving, None, names)
    views = _recorded_views(camera, recorded.shape[0], input_views)
    return Viewpoints(recorded[views], False, views, [f"camera_{view:02d}" for view in views])


def _recorded_views(camera: str | int | Sequence[int], num_views: int, input_views: Sequence[int]) -> list[int]:
    if camera == "input":
        views = list(input_views)
    elif camera == "all":
        views = list(range(num_views))
    elif isinstance(camera, int):
        views = [camera]
    elif isinstance(camera, list | tuple) and camera and all(isinstance(view, int) for view in camera):
        views = list(camera)
    else:
        raise ConfigError(
            f"camera={camera} means nothing.\nAllowed: input, all, ring, a number, a list [0,5], or FILE.json."
        )
    wrong = [view for view in views if not 0 <= view < num_views]
    if wrong:
        raise ConfigError(f"There is no camera {wrong[0]}: the recording has {num_views} (0 to {num_views - 1}).")
    return views


def film(
    simulator: Simulator,
    clip: Clip,
    num_steps: int,
    input_views: Sequence[int],
    viewpoints: Viewpoints,
    progress: Callable[[str, int, int], None],
) -> tuple[list[Particles], UInt8[Tensor, "time camera height width 3"]]:
    """Roll out ``num_steps`` steps and render them; time 0 is the last input frame, reconstructed.

    For a moving camera the camera axis has length 1.
    """
    scene = encode_clip(simulator, clip, input_views)
    states = [scene.current, *simulator.rollout(scene, num_steps)]
    frames = []
    for time, state in enumerate(states):
        progress("frames", time, len(states))
        cameras = viewpoints.cameras[time : time + 1] if viewpoints.moving else viewpoints.cameras
        image = simulator.render([state], cameras)[0]
        frames.append((image.float().nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).cpu())
    return states, torch.stack(frames)


def write_films(
    folder: Path, viewpoints: Viewpoints, frames: NDArray[np.uint8], truth: NDArray[np.uint8] | None, fps: float
) -> None:
    """Write one film per camera, a picture of the middle frame, and comparisons where the ``truth`` is given.

    ``frames`` and ``truth`` are (time, camera, height, width, 3).
    """
    for number, name in enumerate(viewpoints.names):
        write_video(folder / f"{name}.webm", np.stack([enlarge(image) for image in frames[:, number]]), fps)
        write_png(folder / f"{name}.png", enlarge(frames[len(frames) // 2, number]))
    if truth is None:
        return
    labels = [f"step {step}" for step in range(len(frames))]
    for number, name in enumerate(viewpoints.names):
        write_video(folder / f"{name}_comparison.webm", comparison_frames(truth, frames, [number], labels), fps)
    steps = np.unique(np.linspace(1, len(frames) - 1, min(len(frames) - 1, 6)).round().astype(int)).tolist()
    rows = [(name, truth[1:, i], frames[1:, i]) for i, name in enumerate(viewpoints.names[:_MAX_PANELS])]
    write_contact_sheet(folder / "contact_sheet.png", rows, steps, "truth, prediction and error")


def write_particle_folder(
    folder: Path, simulator: Simulator, clip: Clip, states: Sequence[Particles], formats: Sequence[str]
) -> None:
    """Write each step's particles as ``particles/0000.ply`` and ``.npz``, and ``particles.png``."""
    viewpoint = clip.cameras.cam_to_world[1, :, :3, 3].mean(0)
    shown = set(np.unique(np.linspace(0, len(states) - 1, min(len(states), _MAX_PANELS)).round().astype(int)).tolist())
    panels = []
    if formats:
        (folder / "particles").mkdir()
    for step, state in enumerate(states):
        if not formats and step not in shown:
            continue
        colors = particle_colors(simulator.renderer, state, viewpoint)
        there = state.mask[0]
        positions = state.positions[0][there].float().cpu().numpy()
        features = state.features[0][there].float().cpu().numpy()
        if "ply" in formats:
            write_ply(folder / "particles" / f"{step:04d}.ply", positions, colors)
        if "npz" in formats:
            write_particles(folder / "particles" / f"{step:04d}.npz", positions, features, colors)
        if step in shown:
            panels.append((f"step {step}", positions, colors))
    write_particle_plot(folder / "particles.png", panels, clip.workspace_min, clip.workspace_max)


def recorded_frames(path: Path, start: int, num_steps: int, views: Sequence[int]) -> NDArray[np.uint8] | None:
    """True images (time, view, ...) from the last input frame on; None where the recording is shorter."""
    with TrajectoryReader(path) as reader:
        if start + 2 + num_steps > reader.num_frames:
            return None
        return reader.rgb(range(start + 1, start + 2 + num_steps), views)


def read_context(path: Path, start: int) -> Clip:
    """Read the two context frames of a clip; DataError where the recording lacks them."""
    return read_clip(path, 0, start, num_steps=0, with_state=False)


def resize_viewpoints(viewpoints: Viewpoints, height: int | None, width: int | None) -> Viewpoints:
    """Return the same viewpoints at another image size; other sizes have no truth to compare with."""
    cameras = resized(viewpoints.cameras, height, width)
    same = (cameras.height, cameras.width) == (viewpoints.cameras.height, viewpoints.cameras.width)
    return Viewpoints(cameras, viewpoints.moving, viewpoints.views if same else None, viewpoints.names)


def write_description(path: Path, content: Mapping[str, Any]) -> None:
    """Write what was filmed as JSON."""
    with AtomicPath(path) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n")

"""Roll one recording out and render it from chosen cameras; keep the particles, coloured by the renderer."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.files import AtomicPath
from vpd_lightning.media.filmed_maps import map_pictures, write_maps, z_depth
from vpd_lightning.media.particle_colors import particle_colors
from vpd_lightning.media.particle_files import WRITERS
from vpd_lightning.media.pictures import write_contact_sheet, write_particle_plot, write_png, write_view_sheet
from vpd_lightning.media.video import comparison_frames, enlarge, error_image, write_video
from vpd_lightning.media.viewpoints import Viewpoints
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Driven, Particles

PARTICLE_FORMATS = tuple(WRITERS)
_MAX_PANELS = 4
_MAX_SHEET_VIEWS = 8


@dataclass(frozen=True)
class RenderedRollout:
    """What the cameras saw: colours, z-depth in metres (0 where it is no number) and opacity in [0, 1].

    The axis ``camera`` has length 1 for a moving camera.
    """

    rgb: UInt8[Tensor, "time camera height width 3"]
    depth: Float[Tensor, "time camera height width"]
    opacity: Float[Tensor, "time camera height width"]

    def maps(self, names: Sequence[str], camera: int) -> dict[str, NDArray[np.float32]]:
        """Return the named maps of one camera, each (time, height, width)."""
        return {name: getattr(self, name)[:, camera].numpy() for name in names}


def predict(
    simulator: Simulator, scene: Scene, num_steps: int, freeze_step: int | None, motion: Driven | None = None
) -> dict[int, Particles]:
    """Roll out, and return the states to render by their steps; step 0 is the last input frame.

    With ``freeze_step`` that is one state, so many steps after the last input frame. ``motion`` is that of what is
    driven, at least as long.
    """
    last = num_steps if freeze_step is None else freeze_step
    states = dict(enumerate([scene.current, *simulator.rollout(scene, last, driven=motion)]))
    return states if freeze_step is None else {freeze_step: states[freeze_step]}


def render_rollout(
    simulator: Simulator,
    states: Sequence[Particles],
    viewpoints: Viewpoints,
    progress: Callable[[str, int, int], None],
) -> RenderedRollout:
    """Render the states; a moving camera has one place for each, or, where there is only one state, shows that one.

    Raises:
        ValueError: a moving camera with another number of places.
    """
    cameras = viewpoints.cameras
    if not viewpoints.moving:
        views = [(state, cameras) for state in states]
    else:
        seen = list(states) * cameras.shape[0] if len(states) == 1 else states
        views = [
            (state, cameras[place : place + 1]) for place, state in zip(range(cameras.shape[0]), seen, strict=True)
        ]
    frames: dict[str, list[Tensor]] = {"rgb": [], "depth": [], "opacity": []}
    for number, (state, there) in enumerate(views):
        progress("frames", number, len(views))
        seen_maps = simulator.render_maps([state], there)
        colors = seen_maps.rgbs[0].float().nan_to_num(0.0).clamp(0, 1)
        depth = z_depth(seen_maps.depths[0].float().cpu(), there.to("cpu"))
        frames["rgb"].append((colors * 255).round().to(torch.uint8).cpu())
        frames["depth"].append(depth.nan_to_num(0.0, posinf=0.0, neginf=0.0))
        frames["opacity"].append(seen_maps.opacities[0].float().nan_to_num(0.0).clamp(0, 1).cpu())
    return RenderedRollout(**{name: torch.stack(parts) for name, parts in frames.items()})


def write_videos(
    folder: Path,
    viewpoints: Viewpoints,
    rendered: RenderedRollout,
    truth: NDArray[np.uint8] | None,
    fps: float,
    save_maps: Sequence[str],
    save_films: Sequence[str],
) -> None:
    """Write each camera's films, picture of the middle frame and maps, and comparisons where the ``truth`` is given.

    ``truth`` is (time, camera, height, width, 3). A single frame makes a picture, and no film.
    """
    frames = rendered.rgb.numpy()
    for number, name in enumerate(viewpoints.names):
        for kind in save_films if len(frames) > 1 else ():
            write_video(folder / f"{name}.{kind}", np.stack([enlarge(image) for image in frames[:, number]]), fps)
        write_png(folder / f"{name}.png", enlarge(frames[len(frames) // 2, number]))
        if save_maps:
            cameras = viewpoints.cameras if viewpoints.moving else viewpoints.cameras[number]
            opacity = rendered.opacity[:, number].numpy()
            write_maps(folder, name, rendered.maps(save_maps, number), opacity, cameras, fps)
    if truth is None or len(frames) == 1:
        return
    labels = [f"step {step}" for step in range(len(frames))]
    for number, name in enumerate(viewpoints.names):
        for kind in save_films:
            write_video(folder / f"{name}_comparison.{kind}", comparison_frames(truth, frames, [number], labels), fps)
    steps = np.unique(np.linspace(1, len(frames) - 1, min(len(frames) - 1, 6)).round().astype(int)).tolist()
    rows = [(name, truth[1:, i], frames[1:, i]) for i, name in enumerate(viewpoints.names[:_MAX_PANELS])]
    write_contact_sheet(folder / "contact_sheet.png", rows, steps, "truth, prediction and error")


def write_moment_sheet(
    folder: Path,
    viewpoints: Viewpoints,
    rendered: RenderedRollout,
    truth: NDArray[np.uint8] | None,
    step: int,
    save_maps: Sequence[str],
) -> None:
    """Write ``contact_sheet.png``: one predicted moment from every camera, or from up to eight places of a moving one.

    ``truth`` is (time=1, camera, height, width, 3), and only there for cameras of the recording.
    """
    axis = 1 if viewpoints.moving else 0  # what has length 1: the cameras, or the moments
    images = rendered.rgb.select(axis, 0).numpy()
    picked = _places(len(images), viewpoints.is_cycle)
    lines: dict[str, NDArray[np.uint8]] = {"prediction": images[picked]}
    if truth is not None:
        shown = truth[0][picked]
        lines = {"truth": shown, **lines, "error": error_image(lines["prediction"], shown)}
    maps = {name: getattr(rendered, name).select(axis, 0).numpy()[picked] for name in save_maps}
    notes = []
    opacity = rendered.opacity.select(axis, 0).numpy()[picked]
    for kind, (pictures, caption) in map_pictures(maps, opacity).items():
        lines[kind] = pictures
        notes.append(caption)
    title = "; ".join([f"step {step}", *notes])
    write_view_sheet(folder / "contact_sheet.png", lines, [viewpoints.labels[i] for i in picked], title)


def _places(count: int, is_cycle: bool) -> NDArray[np.int64]:
    """Choose up to eight places evenly: both ends of a path, the first end alone of what ends where it began."""
    if count <= _MAX_SHEET_VIEWS:
        return np.arange(count)
    return np.linspace(0, count if is_cycle else count - 1, _MAX_SHEET_VIEWS, endpoint=not is_cycle).round().astype(int)


def write_particle_folder(
    folder: Path, simulator: Simulator, clip: Clip, states: Mapping[int, Particles], formats: Sequence[str]
) -> None:
    """Write each step's particles as ``particles/0000.ply``, ``.npz`` and ``.glb``, and ``particles.png``."""
    viewpoint = clip.cameras.cam_to_world[1, :, :3, 3].mean(0)
    steps = list(states)
    shown = {steps[i] for i in np.linspace(0, len(steps) - 1, min(len(steps), _MAX_PANELS)).round().astype(int)}
    panels = []
    if formats:
        (folder / "particles").mkdir()
    for step, state in states.items():
        if not formats and step not in shown:
            continue
        colors = particle_colors(simulator.renderer, state, viewpoint)
        there = state.mask[0]
        positions = state.positions[0][there].float().cpu().numpy()
        features = state.features[0][there].float().cpu().numpy()
        for kind in formats:
            WRITERS[kind](folder / "particles" / f"{step:04d}.{kind}", positions, features, colors)
        if step in shown:
            panels.append((f"step {step}", positions, colors))
    write_particle_plot(folder / "particles.png", panels, clip.workspace_min, clip.workspace_max)


def recorded_frames(path: Path, start: int, steps: Sequence[int], views: Sequence[int]) -> NDArray[np.uint8] | None:
    """True images (time, view, ...) at ``steps`` (0 is the last input frame); None where the recording is shorter."""
    with TrajectoryReader(path) as reader:
        frames = [start + 1 + step for step in steps]
        return None if frames[-1] >= reader.num_frames else reader.rgb(frames, views)


def read_context(path: Path, start: int) -> Clip:
    """Read the two context frames of a clip; DataError where the recording lacks them."""
    return read_clip(path, 0, start, num_steps=0, with_state=False)


def write_description(path: Path, content: Mapping[str, Any]) -> None:
    """Write what was rendered as JSON."""
    with AtomicPath(path) as partial:
        partial.write_text(json.dumps(content, indent=1) + "\n")

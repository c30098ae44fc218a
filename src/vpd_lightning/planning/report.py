"""What became of a plan, as a film and as JSON: what was seen, what was planned, what happened then."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.files import AtomicPath
from vpd_lightning.media.video import enlarge, framed, label_bar, write_video
from vpd_lightning.planning.closed_loop import Episode, World
from vpd_lightning.planning.tasks import FALLEN, PLACE_TOLERANCE, ROOM_RADIUS, Task
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Cameras

_GREEN = np.array([40, 200, 90], np.uint8)
_RING_POINTS = 720


def write_episode(
    folder: Path,
    simulator: Simulator,
    world: World,
    task: Task,
    episode: Episode,
    details: Mapping[str, Any],
    frames_per_second: float,
) -> None:
    """Write ``plan.json`` and, where cameras were looked through, ``plan.webm`` of the first camera."""
    content = {
        **details,
        "goal": task.goal.tolist(),
        "solved": episode.solved,
        "limits": {"place_tolerance": PLACE_TOLERANCE, "room_radius": ROOM_RADIUS, "fallen": FALLEN},
        "seconds_per_decision": episode.seconds,
        "costs": episode.costs,
        "places": [places.tolist() for places in episode.places],
    }
    with AtomicPath(folder / "plan.json") as path:
        path.write_text(json.dumps(content, indent=1) + "\n")
    if len(episode.moments) > 1:
        write_video(folder / "plan.webm", episode_frames(simulator, world, task, episode), frames_per_second)


def episode_frames(simulator: Simulator, world: World, task: Task, episode: Episode) -> NDArray[np.uint8]:
    """Return a picture for each decision: seen | planned for the next decision | seen then; the goal is marked."""
    intrinsics, poses = world.cameras()
    height, width = episode.moments[0].depth.shape[-2:]
    camera = Cameras.from_arrays(intrinsics[:1], poses[:1], height, width)
    mark = _goal_pixels(task, intrinsics[0], poses[0], height, width)
    frames = []
    for number, (now, then, plan) in enumerate(
        zip(episode.moments[:-1], episode.moments[1:], episode.plans[:-1], strict=True)
    ):
        drawn, planned = now.rgb[0], "seems solved: stays"
        if plan is not None:
            reached, planned = plan.states[episode.num_steps - 1], "planned"
            drawn = (simulator.render([reached], camera)[0, 0].clamp(0, 1) * 255).round().byte().cpu().numpy()
        panels = []
        titles = (f"seen, decision {number + 1}", planned, "what happened")
        for picture, title in zip((now.rgb[0], drawn, then.rgb[0]), titles, strict=True):
            shown = picture.copy()
            shown[mark] = _GREEN
            panel = framed(enlarge(shown))
            panels.append(np.concatenate([label_bar(title, panel.shape[1]), panel], axis=0))
        frames.append(np.concatenate(panels, axis=1))
    return np.stack(frames)


def _goal_pixels(
    task: Task, intrinsics: NDArray[np.float64], pose: NDArray[np.float64], height: int, width: int
) -> NDArray[np.bool_]:
    """Return the pixels of the first camera on which the goal is drawn: a ring, or the table's outline."""
    angle = np.linspace(0, 2 * np.pi, _RING_POINTS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if task.kind == "off_table":
        ring = around / np.abs(around / task.half_size).max(axis=1, keepdims=True)
    else:
        ring = task.goal + (PLACE_TOLERANCE if task.kind == "place" else ROOM_RADIUS) * around
    points = np.concatenate([ring, np.zeros((len(ring), 1))], axis=1)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    there = local[:, 2] > 0
    pixels = (local[there] / local[there, 2:]) @ intrinsics.T
    column, row = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    mark = np.zeros((height, width), bool)
    mark[row[inside], column[inside]] = True
    return mark

"""A tiny data set with exact ground truth, drawn by intersecting rays with a box and a floor, and its oracle."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.data.recordings import write_dataset_file
from vpd_lightning.data.clip import Clip
from vpd_lightning.data.ground_truth import GroundTruth, read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.schema import Trajectory, write_trajectory
from vpd_lightning.evaluation.bodies import Body
from vpd_lightning.evaluation.motion import body_tracks
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.metrics.body_track import measure_bodies
from vpd_lightning.metrics.registry import metric
from vpd_lightning.metrics.rigid_motion import inside_box, move_with_body
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Cameras, Particles

SIZE, NUM_VIEWS, NUM_FRAMES = 24, 2, 10
HALF_SIZE = np.array([[0.25, 0.2, 0.15]])
FLOOR_HEIGHT = -0.5


def look_at(eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pose of a camera at ``eye`` that looks at the origin, OpenCV axes."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


CAM_TO_WORLD = np.stack([look_at(np.array([1.6, 0.3, 1.0])), look_at(np.array([-0.4, 1.7, 1.1]))])
INTRINSICS = np.repeat(np.array([[[26.0, 0, 12], [0, 26.0, 12], [0, 0, 1]]]), NUM_VIEWS, axis=0)


def draw(position: NDArray, quaternion: NDArray, view: int) -> tuple[NDArray, NDArray, NDArray]:
    """Colour (uint8), z-depth (metres) and segmentation of a box over a striped floor, seen from one camera."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    k, pose = INTRINSICS[view], CAM_TO_WORLD[view]
    local = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)], axis=-1)
    direction, eye = local @ pose[:3, :3].T, pose[:3, 3]
    rotation = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    inverse = 1.0 / (direction @ rotation)
    corner = (eye - position) @ rotation
    first, second = (-HALF_SIZE[0] - corner) * inverse, (HALF_SIZE[0] - corner) * inverse
    enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
    floor = np.where(direction[..., 2] < 0, (FLOOR_HEIGHT - eye[2]) / direction[..., 2], 0.0)
    floor = np.where((floor > 0) & (floor < 6), floor, 0.0)
    hit = (enter < leave) & (enter > 0) & ((floor == 0) | (enter < floor))
    point = eye + floor[..., None] * direction
    stripes = (np.floor(4 * point[..., 0]) % 2 == 0)[..., None]
    colors = np.where(floor[..., None] > 0, np.where(stripes, [90, 100, 110], [150, 140, 120]), [30, 30, 40])
    face = np.minimum(first, second).argmax(-1)
    colors = np.where(hit[..., None], np.array([[230, 60, 40], [60, 200, 70], [50, 90, 230]])[face], colors)
    return colors.astype(np.uint8), np.where(hit, enter, floor).astype(np.float32), hit.astype(np.uint8)


def tossed_box(seed: int) -> Trajectory:
    """A box in free flight at 20 frames per second that starts near the origin."""
    random = np.random.default_rng(seed)
    time = 0.05 * np.arange(NUM_FRAMES)[:, None]
    velocity, spin = random.uniform(-0.6, 0.6, 3) + [0, 0, 0.8], random.uniform(-3, 3, 3)
    positions = random.uniform(-0.1, 0.1, 3) + velocity * time - [0, 0, 4.9] * time**2
    quaternions = np.roll((Rotation.from_rotvec(spin * time) * Rotation.random(rng=seed)).as_quat(), 1, axis=-1)
    images = [[draw(positions[t], quaternions[t], v) for v in range(NUM_VIEWS)] for t in range(NUM_FRAMES)]
    rgb, depth, segmentation = (np.stack([np.stack([view[i] for view in row]) for row in images]) for i in range(3))
    return Trajectory(
        rgb=rgb,
        depth=depth,
        intrinsics=INTRINSICS,
        cam_to_world=CAM_TO_WORLD,
        frame_time=0.05,
        near=0.3,
        far=5.0,
        workspace_min=(-1.0, -1.0, -1.0),
        workspace_max=(1.0, 1.0, 1.0),
        seed=seed,
        state={
            "positions": positions[:, None],
            "quaternions": quaternions[:, None],
            "linear_velocities": (velocity - [0, 0, 9.8] * time)[:, None],
            "angular_velocities": np.broadcast_to(spin, positions.shape)[:, None].copy(),
            "half_sizes": HALF_SIZE,
            "segmentation": segmentation,
        },
    )


def write_tossed_boxes(folder: Path, num_train: int = 3, num_test: int = 3) -> Path:
    """Write a data set with a train and a test split and return its folder."""
    splits: dict[str, list[Path]] = {"train": [], "validation": [], "test": []}
    for split, count, first in (("train", num_train, 0), ("test", num_test, 100)):
        for index in range(count):
            path = folder / split / f"{index:06d}.h5"
            write_trajectory(path, tossed_box(first + index))
            splits[split].append(path)
    return write_dataset_file(folder, splits)


class Oracle:
    """Has the simulator's Python face and knows the future: particles follow the true poses, images are redrawn.

    It recognises a clip by its pixels. A particle's features are its trajectory's number and its frame.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.states: list[GroundTruth] = [read_state(path) for path in paths]
        self.frames: dict[bytes, tuple[int, int]] = {}
        for number, path in enumerate(paths):
            with TrajectoryReader(path) as reader:
                for time, image in enumerate(reader.rgb(None, [0])):
                    self.frames[image[0].tobytes()] = (number, time)

    def pose(self, number: int, time: int) -> torch.Tensor:
        state, last = self.states[number], len(self.states[number].positions) - 1
        time = min(time, last)
        return torch.tensor(np.concatenate([state.positions[time, 0], state.quaternions[time, 0]]))

    def encode(self, rgb: torch.Tensor, depth: torch.Tensor, cameras: Cameras) -> Scene:
        assert rgb.dtype == torch.uint8 and rgb.shape[0] == 2
        states = []
        for time in range(2):
            number, frame = self.frames[rgb[time, 0].numpy().tobytes()]
            points = unproject(depth[time].double(), cameras[time].to(torch.float64))[depth[time] > 0]
            points = points[(points.abs() <= 1).all(-1)]
            features = torch.tensor([float(number), float(frame)]).expand(len(points), 2)
            states.append(Particles(points[None], features[None]))
        return Scene(*states)

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        number, frame = (int(value) for value in scene.current.features[0, 0])
        points, start = scene.current.positions[0], self.pose(number, frame)
        body = inside_box(points, start, torch.from_numpy(HALF_SIZE[0]), 0.02)
        states = []
        for step in range(1, num_steps + 1):
            moved = points.clone()
            moved[body] = move_with_body(points[body], start, self.pose(number, frame + step)[None])[0]
            features = torch.tensor([float(number), float(frame + step)]).expand(len(points), 2)
            states.append(Particles(moved[None], features[None]))
        return states

    def render(self, states: Sequence[Particles], cameras: Cameras) -> torch.Tensor:
        images = []
        for state in states:
            number, frame = (int(value) for value in state.features[0, 0])
            pose = self.pose(number, frame).numpy()
            images.append(np.stack([draw(pose[:3], pose[3:], view)[0] for view in range(cameras.shape[0])]))
        return torch.from_numpy(np.stack(images)).float() / 255.0


class Swaying(Oracle):
    """An oracle whose particles sway by centimetres and swell, and whose images are too dark: every metric is busy."""

    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]:
        states = []
        for step, state in enumerate(super().rollout(scene, num_steps), start=1):
            sway = 0.02 * torch.sin(7.0 * state.positions.roll(1, dims=-1) + step)
            states.append(Particles(state.positions * (1 + 0.01 * step) + sway, state.features))
        return states

    def render(self, states: Sequence[Particles], cameras: Cameras) -> torch.Tensor:
        return 0.9 * super().render(states, cameras)


def clip_penetration(
    clip: Clip, bodies: Sequence[Body], positions: Float[Tensor, "time particle 3"]
) -> dict[str, Float[Tensor, "object step"]]:
    """Depth of every body's deepest particle in what is solid, by part."""
    return measure_bodies(metric("penetration"), body_tracks(clip, bodies, positions, None))

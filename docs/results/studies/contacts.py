"""How true contact is on pushing: when bodies are set in motion, how deep they sink, what rests, and what falls.

``python -m docs.results.studies.contacts OUT.json DATA NAME=CKPT ... [--split test --starts 0 6 12]`` rolls every
checkpoint out over 32 steps with the true action (a model without actions gets none) and compares, body by body:

- ``onsets``: bodies at rest that the pusher or another body sets in motion (by more than ``MOVED``; one that topples by
  itself is none): the share whose predicted motion begins within two frames of the true one, how much later it begins,
  how many never move; and how many of those that truly stay are moved;
- ``penetration`` (mm): the true shapes, carried as the body's particles moved (rigid fit), against each other, the
  pusher and the table by MuJoCo's ``mj_geomDistance``: the deepest place of each frame, mean and 95th percentile;
- ``drift`` (mm): what bodies that truly stay move within 32 steps;
- ``falls``: bodies that truly fall off the table, and whether they do in the prediction.

Beside them the same numbers of the true motion (``truth``).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.pushing.bodies import draw_bodies
from data_gen.pushing.model import compile_model
from data_gen.pushing.settings import PushingSettings
from data_gen.settings import SPLIT_CODES, load_settings
from docs.results.studies.changed_dynamics import change_dynamics, parser_of
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.motion import trajectory_of
from vpd_lightning.evaluation.prediction import encode_clip, roll_out_clip
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.metrics.body_dynamics import best_rotation

STEPS = 32
MOVED = 0.005  # metres: a body that was at rest is set in motion
AT_REST = 0.001  # metres: what truly stays moves less within the clip
WITHIN = 2  # frames
FALLEN = -0.02  # metres: a centre so far below the table's top has left it
MIN_PARTICLES = 5
TOUCHING = 0.005  # metres, between what was set in motion and what did it, in one of the frames before
_FAR = 0.05  # metres: farther apart, MuJoCo need not measure


@dataclass
class Counts:
    """What is collected over clips."""

    late: list[float] = field(default_factory=list)  # frames; infinite: never moves
    false_starts: list[bool] = field(default_factory=list)
    drift: list[float] = field(default_factory=list)  # metres
    depth: dict[str, list[float]] = field(default_factory=dict)  # metres, of a frame
    falls: list[float] = field(default_factory=list)  # frames later; infinite: does not fall
    false_falls: list[bool] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Return shares and means of what was collected."""
        late, falls = np.array(self.late), np.array(self.falls)
        hit = late[np.isfinite(late)]
        return {
            "onsets": {
                "bodies": len(late),
                "within_two_frames": float(np.mean(np.abs(late) <= WITHIN)),
                "frames_later": float(np.mean(hit)) if len(hit) else None,
                "never": float(np.mean(~np.isfinite(late))),
                "bodies_that_stay": len(self.false_starts),
                "of_these_moved": float(np.mean(self.false_starts)),
            },
            "penetration_mm": {
                kind: {"mean": 1000 * float(np.mean(values)), "95 %": 1000 * float(np.percentile(values, 95))}
                for kind, values in sorted(self.depth.items())
            },
            "drift_mm": {
                "bodies": len(self.drift),
                "median": 1000 * float(np.median(self.drift)),
                "mean": 1000 * float(np.mean(self.drift)),
                "largest": 1000 * float(np.max(self.drift)),
            },
            "falls": {
                "bodies": len(falls),
                "fall": float(np.mean(np.isfinite(falls))),
                "within_two_frames": float(np.mean(np.abs(falls) <= WITHIN)),
                "bodies_that_stay": len(self.false_falls),
                "of_these_fall": float(np.mean(self.false_falls)),
            },
        }


class Shapes:
    """The true shapes of a recording in MuJoCo, to be put where a prediction has them."""

    def __init__(self, settings: PushingSettings, seed: int, split: str, index: int) -> None:
        generator = np.random.default_rng([seed, SPLIT_CODES[split], index])
        self.model = compile_model(settings, draw_bodies(settings, generator))
        self.data = mujoco.MjData(self.model)
        bodies = [number for number in range(self.model.ngeom) if self.model.geom(number).name.startswith("body")]
        still = [self.model.geom(name).id for name in ("top", "floor", "foot")]
        pusher = self.model.geom("pusher").id
        self.pairs = {
            "pusher": [(body, pusher) for body in bodies],
            "table": [(body, other) for body in bodies for other in still],
            "bodies": [(one, other) for one in bodies for other in bodies if one < other],
        }

    def depths(self, poses: NDArray[np.float64], pusher: NDArray[np.float64]) -> dict[str, float]:
        """Return how deep (m) bodies at ``poses`` (body, 7) lie in the pusher (its middle, (3,)), table, each other."""
        self._put(poses, pusher)
        return {kind: max([0.0] + [-self._gap(pair) for pair in pairs]) for kind, pairs in self.pairs.items()}

    def is_touched(self, body: int, poses: NDArray[np.float64], pusher: NDArray[np.float64]) -> bool:
        """Return whether the pusher or another body is within ``TOUCHING`` of a body."""
        self._put(poses, pusher)
        geom = self.model.geom(f"body{body}").id
        return any(geom in pair and self._gap(pair) < TOUCHING for pair in self.pairs["pusher"] + self.pairs["bodies"])

    def _put(self, poses: NDArray[np.float64], pusher: NDArray[np.float64]) -> None:
        self.data.qpos[:-2] = poses.reshape(-1)
        self.data.qpos[-2:] = pusher[:2]
        mujoco.mj_kinematics(self.model, self.data)

    def _gap(self, pair: tuple[int, int]) -> float:
        return float(mujoco.mj_geomDistance(self.model, self.data, *pair, _FAR, None))


def carried(start: NDArray[np.float64], points: torch.Tensor) -> NDArray[np.float64]:
    """Return the poses (step, 7) of a body from that at the ``start`` (7,) on, as its ``points`` (time, p, 3) moved."""
    turns = best_rotation(points[0], points[1:]).numpy()
    middle = points.mean(dim=1).numpy()
    offset = np.einsum("sij,j->si", turns, start[:3] - middle[0])
    quaternion = Rotation.from_matrix(turns) * Rotation.from_quat(start[3:], scalar_first=True)
    return np.concatenate([middle[1:] + offset, quaternion.as_quat(scalar_first=True)], axis=1)


def onset(places: NDArray[np.float64]) -> float:
    """Return the step at which a centre (time, 3) is ``MOVED`` from where it was; infinite: never."""
    gone = np.linalg.norm(places[1:] - places[0], axis=-1) > MOVED
    return float(np.argmax(gone) + 1) if gone.any() else np.inf


def fall(places: NDArray[np.float64]) -> float:
    """Return the step at which a centre (time, 3) is below the table's top; infinite: never."""
    below = places[1:, 2] < FALLEN
    return float(np.argmax(below) + 1) if below.any() else np.inf


def compare(counts: Counts, clip: Clip, pred: NDArray[np.float64], shown: Sequence[bool], shapes: Shapes) -> None:
    """Add a clip whose bodies are predicted at ``pred`` (time, body, 7), the observed poses first."""
    true = clip.poses(STEPS).numpy()
    before = clip.previous_pose().numpy()
    assert clip.driven is not None
    pusher = clip.driven.positions.double().mean(dim=1).numpy()[-STEPS - 1 :]
    for number in [n for n, is_shown in enumerate(shown) if is_shown]:
        places, ours = true[:, number, :3], pred[:, number, :3]
        if places[0, 2] < FALLEN:
            continue
        stays = np.linalg.norm(places - places[0], axis=-1).max() < AT_REST
        if np.linalg.norm(places[0] - before[number, :3]) < AT_REST / 2:
            begins = onset(places)
            if np.isfinite(begins):
                frames = range(max(0, int(begins) - WITHIN), int(begins) + 1)
                if not any(shapes.is_touched(number, true[frame], pusher[frame]) for frame in frames):
                    continue
                counts.late.append(onset(ours) - onset(places))
            elif stays:
                counts.false_starts.append(bool(np.isfinite(onset(ours))))
                counts.drift.append(float(np.linalg.norm(ours[-1] - ours[0])))
        if np.isfinite(fall(places)):
            counts.falls.append(fall(ours) - fall(places))
        else:
            counts.false_falls.append(bool(np.isfinite(fall(ours))))
    for step in range(1, STEPS + 1):
        for kind, depth in shapes.depths(pred[step], pusher[step]).items():
            counts.depth.setdefault(kind, []).append(depth)


def predicted(model: LoadedModel, clip: Clip) -> tuple[NDArray[np.float64], list[bool]]:
    """Return predicted poses (time, body, 7), the true ones at the start first, and which bodies particles show."""
    scene = encode_clip(model.simulator, clip, model.input_views)
    positions = trajectory_of(scene.current, roll_out_clip(model.simulator, scene, clip, STEPS))
    true = clip.poses(STEPS).numpy()
    found, shown = np.repeat(true[:1], STEPS + 1, axis=0), []
    for number, body in enumerate(find_bodies(clip, positions[0], model.config["protocol"]["body_margin"], STEPS)):
        shown.append(int(body.mask.sum()) >= MIN_PARTICLES)
        if shown[-1]:
            found[1:, number] = carried(true[0, number], positions[:, body.mask])
    return found, shown


@torch.no_grad()
def measured(
    model: LoadedModel | None, data: Path, split: str, starts: Sequence[int], settings: PushingSettings, seed: int
) -> dict[str, Any]:
    """Return what is compared for one model; None: for the true motion."""
    counts = Counts()
    for number, path in enumerate(sorted((data / split).glob("*.h5"))):
        shapes = Shapes(settings, seed, split, number)
        for start in starts:
            clip = read_clip(path, number, start, STEPS)
            if model is None:
                pred = clip.poses(STEPS).numpy()
                shown = [True] * pred.shape[1]
            else:
                pred, shown = predicted(model, clip)
            compare(counts, clip, pred, shown, shapes)
    return counts.summary()


def main() -> None:
    """Measure the models and print what was found."""
    options = parser_of(__doc__, "*").parse_args()
    torch.set_num_threads(1)
    manifest = load_manifest(options.data)
    settings = load_settings(PushingSettings, "pushing", manifest.preset, {})
    result = json.loads(options.out.read_text()) if options.out.is_file() else {}
    for words in ["truth=", *options.models]:
        name, ckpt = words.split("=", 1)
        model = load_model(ckpt) if ckpt else None
        changes = {} if model is None else change_dynamics(model, options.dynamics)
        found = measured(model, options.data, options.split, options.starts, settings, manifest.seed)
        result[name] = {**found, "starts": options.starts, "dynamics": changes}
        with AtomicPath(options.out) as path:
            path.write_text(json.dumps(result, indent=1) + "\n")
        print(name, json.dumps(result[name], indent=1))


if __name__ == "__main__":
    main()

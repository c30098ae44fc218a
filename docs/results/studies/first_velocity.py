"""The velocity of the first frame against the true one, on every scene.

``python -m docs.results.studies.first_velocity``. No model is trained: two frames of RGB-D go in. *Point error* is
the root mean square error of the particles' velocity over the root mean square of their true velocity; *centre error*
is the same for the true centres of the bodies, moved as the particles seen of them are said to move. Particles that
belong to no true body, by less than ``MARGIN``, are not judged; how many of those said to move are such is ``stray``,
and how many particles of true bodies are said to stand still is ``missed``. *Zero* errs by 100 %. ``no colours``
matches places alone, ``unfinished`` leaves out the tangent planes, ``no pictures`` what the images tell besides their
particles' colours, ``one body`` takes all that may move for one body.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.measuring import Result, Row
from benchmarks.results_files import write
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.dynamics.inertial import InertialDynamics
from vpd_lightning.dynamics.inertial.rigid_motion import fit_twists, rotate, rotation_from_spin
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Simulator

SCENES = (
    "mujoco_block", "demo", "deformable_block", "deformable_multi", "deformable_collision", "movi_a", "movi_b",
    "movi_c",
)  # fmt: skip
FOLDERS = {"demo": "mujoco_block_demo"}
VARIANTS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "no colours": {"color_scale": 1e3},
    "unfinished": {"num_plane_rounds": 1, "tangential_weight": 1e3},
    "no pictures": {"picture_weight": 0.0},
    "one body": {},
}
MARGIN = {"deformable": 0.1}  # metres around a true body; soft bodies are drawn 2 cm outside of their mesh


@dataclass(frozen=True)
class Judged:
    """One true body of one clip: sums of squares (square metres), and counts of particles."""

    point_error: float
    point_speed: float
    center_error: float
    center_speed: float
    num_particles: int
    num_missed: int


def simulator_for(scene: str, variant: str) -> Simulator:
    """Return the untrained inertial system of a scene."""
    config = compose("train", ["run.folder=unused", f"experiment={scene}", "model=inertial", "size=small"])
    if variant == "one body":
        config["dynamics"]["num_bodies"] = 1
    config["dynamics"]["first_velocity"] |= VARIANTS[variant]
    return build_simulator(config).eval()


def clips(folder: Path, split: str, count: int, starts: Sequence[int]) -> Iterator[Clip]:
    """Read the clips; they need one predicted step, for the truth."""
    for number, path in enumerate(load_manifest(folder).split(split)[:count]):
        for start in starts:
            yield read_clip(path, number, start, 1)


@torch.no_grad()
def judge(simulator: Simulator, clip: Clip, views: Sequence[int], margin: float) -> tuple[list[Judged], int, float]:
    """Return the bodies that are seen, the number of particles that are said to move without a body, and seconds."""
    scene = encode_clip(simulator, clip, list(views))
    dynamics = simulator.dynamics
    assert isinstance(dynamics, InertialDynamics)
    start = time.perf_counter()
    memory = dynamics.initialize(scene.previous, scene.current, RandomKeys.fixed(1))
    seconds = time.perf_counter() - start
    positions = scene.current.positions[0]
    index = memory.index[0][memory.mask[0]]
    own, motion = memory.own[0][memory.mask[0]], memory.motion
    velocity = torch.zeros_like(positions)
    back = rotation_from_spin(-motion.spins)[0, own]
    local = positions[index] - memory.origin[0]
    offsets = local - motion.centers[0, own]
    before = (motion.centers - motion.displacements)[0, own] + rotate(back, offsets)
    velocity[index] = local - before
    said = torch.zeros(len(positions), dtype=torch.bool).index_fill_(0, index, True)
    stray, judged = said.clone(), []
    centers = clip.poses(1)[0, :, :3], clip.previous_pose()[:, :3]
    for number, body in enumerate(find_bodies(clip, positions.double(), margin, 1)):
        stray &= ~body.mask
        mask = body.mask & said
        if mask.sum() < 8:
            continue
        true = body.true[0] - body.before
        error = velocity[body.mask].double() - true
        seen = said[body.mask]
        center = _carried(centers[0][number], positions[mask].double(), velocity[mask].double())
        judged.append(
            Judged(
                point_error=float(error[seen].square().sum(dim=-1).mean()),
                point_speed=float(true[seen].square().sum(dim=-1).mean()),
                center_error=float((center - (centers[0] - centers[1])[number]).square().sum()),
                center_speed=float((centers[0] - centers[1])[number].square().sum()),
                num_particles=int(body.mask.sum()),
                num_missed=int((body.mask & ~said).sum()),
            )
        )
    return judged, int(stray.sum()), seconds


def _carried(
    point: Float[Tensor, " 3"], positions: Float[Tensor, "particle 3"], velocity: Float[Tensor, "particle 3"]
) -> Float[Tensor, " 3"]:
    """Return the velocity of a point that moves rigidly with particles."""
    weights = torch.full((1, 1, len(positions)), 1 / len(positions), dtype=positions.dtype)
    fitted = fit_twists(positions[None], velocity[None], weights)
    back = rotate(rotation_from_spin(-fitted.spins[0, 0]), point - fitted.centers[0, 0])
    return point - (fitted.centers[0, 0] - fitted.displacements[0, 0] + back)


def measure(
    root: Path, scenes: Sequence[str], variants: Sequence[str], split: str, count: int, starts: Sequence[int]
) -> Result:
    """Return one row for each scene and variant; ``error`` is the point error as a share of the true speed."""
    rows: list[Row] = []
    facts: dict[str, Any] = {"split": split, "trajectories": count, "start frames": ", ".join(map(str, starts))}
    for scene in scenes:
        folder = root / FOLDERS.get(scene, f"{scene}_small")
        margin = next((value for name, value in MARGIN.items() if scene.startswith(name)), 0.02)
        reference = None
        for variant in variants:
            simulator = simulator_for(scene, variant)
            views = compose("train", ["run.folder=unused", f"experiment={scene}"])["scene"]["input_views"]
            bodies, stray, seconds = [], 0, []
            for clip in clips(folder, split, count, starts):
                found, strays, spent = judge(simulator, clip, views, margin)
                bodies += found
                stray += strays
                seconds.append(spent)
            row, more = _row(scene, variant, bodies, stray, min(seconds))
            reference = reference or row
            rows.append(replace(row, baseline_seconds=reference.seconds, ratio=reference.seconds / row.seconds))  # type: ignore[operator]
            facts |= {f"{scene}, {variant}: {name}": value for name, value in more.items()}
    return Result(rows, facts)


def _row(
    scene: str, variant: str, bodies: Sequence[Judged], stray: int, seconds: float
) -> tuple[Row, dict[str, float]]:
    def mean(name: str) -> float:
        return sum(getattr(body, name) for body in bodies) / max(len(bodies), 1)

    point = (mean("point_error") / mean("point_speed")) ** 0.5
    center = (mean("center_error") / mean("center_speed")) ** 0.5
    each = torch.tensor([body.point_error for body in bodies]).sqrt() / mean("point_speed") ** 0.5
    total = sum(body.num_particles for body in bodies)
    more = {
        "point error (share of the speed)": point,
        "median body's point error": float(each.median()),
        "centre error (share of the speed)": center,
        "rms speed (m a step)": mean("point_speed") ** 0.5,
        "bodies": len(bodies),
        "missed (share of particles on bodies)": sum(body.num_missed for body in bodies) / max(total, 1),
        "stray (per particle on bodies)": stray / max(total, 1),
    }
    note = f"centre error {center:.1%}, median body {float(each.median()):.1%}, {len(bodies)} bodies"
    return Row(f"{scene}/{variant}", f"{scene}/as it is", seconds, None, None, point, None, None, note), more


def main() -> None:
    """Measure from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=Path("datasets"), help="folder of the data sets")
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--split", default="test")
    parser.add_argument("--count", type=int, default=16, help="trajectories")
    parser.add_argument("--starts", nargs="+", type=int, default=[0, 4], help="first of the two frames")
    parser.add_argument("--out", type=Path, default=Path("runs/first_velocity"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(given.root, given.scenes, given.variants, given.split, given.count, given.starts)
    write("first_velocity", torch.device("cpu"), result, given.out)


if __name__ == "__main__":
    main()

"""What if a body were not there, or elsewhere? Edited rollouts against MuJoCo's own.

``python -m docs.results.studies.edits``. Of a test trajectory of Deformable Collision the model sees two frames just
before the bodies touch. Before its rollout the particles of one body are taken out (``delete``) or put aside
(``move``). MuJoCo goes on from the true state of the last input frame with the same change. The body that was left
alone is judged: Chamfer-L1 distance from its particles to points of its surface in MuJoCo's counterfactual, over the
later half of the rollout. The *unedited* rollout is held against the same counterfactual: an edit that the model does
not take to heart would leave the two alike.

The particles of the edited body are selected by the true surface, as a person would select them by a click.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.results_files import versions
from data_gen.counterfactual import Change
from data_gen.deformable.counterfactual import Counterfactual, at_frame
from data_gen.deformable.settings import DeformableSettings
from data_gen.settings import load_settings
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.loading import load_model
from vpd_lightning.metrics.chamfer import chamfer
from vpd_lightning.metrics.surface_distance import nearest_on_surface, surface_of
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Cameras, Particles

SCENE = "deformable_collision"
MARGIN = 0.1  # metres; bodies are drawn 2 cm outside of their mesh
ASIDE = 4.0  # metres, twice the size of a body
TOUCH = 0.1  # metres between two bodies that are about to touch
NUM_SURFACE_POINTS = 2000


@dataclass(frozen=True)
class Edited:
    """One edit of one trajectory; distances in metres, means over the judged steps."""

    trajectory: int
    start: int
    edit: str
    edited_body: str
    judged_body: str
    edited: float
    unedited: float
    truth_changed_by: float  # Chamfer of MuJoCo without the edit to MuJoCo with it
    last_edited: float
    last_unedited: float


def surface_points(
    vertices: NDArray[np.float64], tetrahedra: NDArray[np.integer], seed: int
) -> Float[Tensor, "step point 3"]:
    """Return points of a body's surface, even in area at the first step, and the same points at all others."""
    triangles = surface_of(tetrahedra)
    corners = vertices[:, triangles]  # step triangle corner 3
    areas = np.linalg.norm(np.cross(corners[0, :, 1] - corners[0, :, 0], corners[0, :, 2] - corners[0, :, 0]), axis=-1)
    generator = np.random.default_rng(seed)
    chosen = generator.choice(len(areas), NUM_SURFACE_POINTS, p=areas / areas.sum())
    weights = generator.dirichlet(np.ones(3), NUM_SURFACE_POINTS)
    return torch.from_numpy(np.einsum("spci,pc->spi", corners[:, chosen], weights))


def edited_state(state: Particles, body: Bool[Tensor, " particle"], shift: Float[Tensor, " 3"] | None) -> Particles:
    """Return the particles without a body, or with it moved by ``shift`` (metres)."""
    if shift is None:
        return replace(state, mask=state.mask & ~body)
    return replace(state, positions=torch.where(body[None, :, None], state.positions + shift, state.positions))


def edited_scene(scene: Scene, clip: Clip, body: int, shift: Float[Tensor, " 3"] | None) -> Scene:
    """Edit both frames; the body's particles are those near its true surface in each."""
    before = replace(clip, start=clip.start - 1)
    states = []
    for moment, state in ((before, scene.previous), (clip, scene.current)):
        found = find_bodies(moment, state.positions[0].double(), MARGIN, 1)[body]
        states.append(edited_state(state, found.mask, shift))
    return Scene(*states)


@torch.no_grad()
def judge(
    simulator: Simulator, clip: Clip, views: Sequence[int], truth: Counterfactual, edit: str, num_steps: int
) -> tuple[Edited, dict[str, Any]]:
    """Edit the upper body, judge the lower one; also return what is needed to draw it."""
    scene = encode_clip(simulator, clip, list(views))
    lower, upper = 0, 1  # a drop lists the lowest body first
    shift = None if edit == "delete" else torch.tensor([ASIDE, 0.0, 0.0])
    change = Change(is_gone=True) if shift is None else Change(shift=shift.tolist())
    counterfactual = truth.run({upper: change}, num_steps)[0]
    factual = truth.run({}, num_steps)[0]
    tetrahedra = truth.drop.meshes[lower].tetrahedra
    target, unchanged = (surface_points(v, tetrahedra, clip.trajectory) for v in (counterfactual, factual))

    mask = find_bodies(clip, scene.current.positions[0].double(), MARGIN, 1)[lower].mask
    changed = edited_scene(scene, clip, upper, shift)
    rollouts = {"edited": simulator.rollout(changed, num_steps), "unedited": simulator.rollout(scene, num_steps)}
    steps = range(num_steps // 2, num_steps)
    distances = {
        name: [chamfer(states[step].positions[0, mask], target[step]).mean for step in steps]
        for name, states in rollouts.items()
    }
    row = Edited(
        trajectory=clip.trajectory,
        start=clip.start,
        edit=edit,
        edited_body=truth.drop.shapes[upper],
        judged_body=truth.drop.shapes[lower],
        edited=float(np.mean(distances["edited"])),
        unedited=float(np.mean(distances["unedited"])),
        truth_changed_by=float(np.mean([chamfer(unchanged[step], target[step]).mean for step in steps])),
        last_edited=distances["edited"][-1],
        last_unedited=distances["unedited"][-1],
    )
    return row, {"rollouts": rollouts, "target": target, "start": scene}


def start_before_touch(path: Path) -> int | None:
    """Return the first of the two frames that end one frame before two bodies come near each other; None if never."""
    state = read_state(path)
    assert state.vertices is not None and state.vertex_objects is not None and state.tetrahedra is not None
    triangles = surface_of(state.tetrahedra)
    upper = triangles[state.vertex_objects[triangles[:, 0]] == 1]
    for frame, vertices in enumerate(state.vertices.astype(np.float64)):
        lower = vertices[state.vertex_objects == 0]
        if nearest_on_surface(lower, vertices[upper]).distance.min() < TOUCH:
            return max(frame - 2, 0) if frame >= 2 else None
    return None


def draw(simulator: Simulator, clip: Clip, parts: dict[str, Any], steps: Sequence[int], path: Path) -> None:
    """Write a picture: unedited and edited rollout from the first camera, and the counterfactual body's points."""
    from PIL import Image

    camera = clip.target_cameras[0][:1]
    rows = []
    for name in ("unedited", "edited"):
        states = parts["rollouts"][name]
        rows.append([simulator.render([states[step]], camera)[0, 0] for step in steps])
    rows.append([_dots(parts["target"][step], camera) for step in steps])
    picture = torch.cat([torch.cat(row, dim=1) for row in rows], dim=0).clamp(0, 1)
    image = Image.fromarray((picture * 255).byte().numpy())
    image.resize((image.width * 3, image.height * 3), Image.Resampling.NEAREST).save(path)


def _dots(points: Float[Tensor, "point 3"], camera: Cameras) -> Float[Tensor, "height width 3"]:
    from vpd_lightning.geometry.cameras import project

    pixels, depth = project(points.to(camera.intrinsics)[None], camera)
    picture = torch.ones(camera.height, camera.width, 3)
    x, y = pixels[0].long().unbind(-1)
    there = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (depth[0] > 0)
    picture[y[there], x[there]] = torch.tensor([0.2, 0.3, 0.7])
    return picture


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge every edit of every trajectory and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="run folder, checkpoint or released model")
    parser.add_argument("--data", type=Path, default=Path("datasets/deformable_collision_small"))
    parser.add_argument("--split", default="test")
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("runs/edits"))
    options = parser.parse_args(arguments)

    model = load_model(options.checkpoint)
    simulator = model.simulator.eval()
    settings = load_settings(DeformableSettings, SCENE, load_manifest(options.data).preset, {})
    views = model.config["scene"]["input_views"]
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[Edited] = []
    for number, path in enumerate(load_manifest(options.data).split(options.split)[: options.count]):
        start = start_before_touch(path)
        if start is None or start + 2 + options.steps > read_state(path).positions.shape[0]:
            print(f"{number:3d} left out: the bodies touch too late, too early or never")
            continue
        clip = read_clip(path, number, start, options.steps)
        truth = at_frame(settings, _attributes(path), path, clip.current_frame)
        for edit in ("delete", "move"):
            row, parts = judge(simulator, clip, views, truth, edit, options.steps)
            rows.append(row)
            print(
                f"{number:3d} {edit:7s} {row.edited_body:>12s} above {row.judged_body:12s} edited {row.edited:.3f}  "
                f"unedited {row.unedited:.3f}  (the truth changes by {row.truth_changed_by:.3f}) m",
                flush=True,
            )
            draw(
                simulator,
                clip,
                parts,
                range(1, options.steps, options.steps // 5),
                options.out / f"edits_{edit}_{number}.png",
            )
    for edit in ("delete", "move"):
        these = [row for row in rows if row.edit == edit]
        better = sum(row.edited < row.unedited for row in these)
        means = [np.mean([getattr(row, name) for row in these]) for name in ("edited", "unedited", "truth_changed_by")]
        print(
            f"{edit}: edited nearer in {better} of {len(these)}; means {means[0]:.3f}, {means[1]:.3f}, {means[2]:.3f} m"
        )
    content = {"checkpoint": str(options.checkpoint), "versions": versions(), "rows": [asdict(row) for row in rows]}
    (options.out / "edits.json").write_text(json.dumps(content, indent=1) + "\n")


def _attributes(path: Path) -> dict[str, Any]:
    import h5py

    with h5py.File(path) as file:
        return dict(file.attrs)


if __name__ == "__main__":
    main()

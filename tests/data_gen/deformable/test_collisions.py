"""Random Deformable Collision trajectories at full length: the physics, without pictures."""

import mujoco
import numpy as np
import pytest

from data_gen.deformable import Settings
from data_gen.deformable.drop import draw_drop
from data_gen.deformable.scene import prepare
from data_gen.deformable.tetrahedra import signed_volumes
from data_gen.settings import load_settings

MAX_PENETRATION = 0.05  # m, of bodies that are 2 m across
ROUNDING = 1e-6  # m


@pytest.mark.slow
@pytest.mark.parametrize(
    "index", [*range(2), *(pytest.param(index, marks=pytest.mark.exhaustive) for index in range(2, 20))]
)
def test_random_collisions_stay_sound(index: int):
    settings = load_settings(Settings, "deformable_collision", "paper", {})
    drop = draw_drop(settings, 0, "train", index)
    model, data, bodies = prepare(settings, drop)
    deepest, have_met = 0.0, False
    for frame in range(settings.num_frames):
        for _ in range(settings.substeps if frame else 0):
            mujoco.mj_step(model, data)
            deepest = max(deepest, -data.contact.dist.min(initial=0.0))
            have_met |= bool((data.contact.flex >= 0).all(axis=1).any())
        mujoco.mj_forward(model, data)
        bodies.observe(frame)

    points = bodies.vertices[-1].astype(np.float64)
    volumes = signed_volumes(points, bodies.tetrahedra)
    assert np.isfinite(bodies.vertices).all() and np.isfinite(bodies.linear).all()
    assert (volumes > 0).all()
    assert have_met, "the two bodies never touched"
    assert deepest < MAX_PENETRATION
    assert bodies.vertices[:, :, 2].min() > -MAX_PENETRATION + settings.bodies.skin - ROUNDING
    # They stay in the workspace, and nothing has swollen or shrunk by the end.
    assert np.abs(bodies.vertices[..., :2]).max() < settings.workspace_max[0]
    assert volumes.sum() == pytest.approx(sum(body.volumes.sum() for body in drop.meshes), rel=0.15)

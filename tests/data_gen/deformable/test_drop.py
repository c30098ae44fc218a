import numpy as np
import pytest

from data_gen.deformable import Settings
from data_gen.deformable.drop import draw_drop
from data_gen.deformable.settings import DeformableSettings
from data_gen.settings import load_settings
from vpd_lightning.errors import DataError


@pytest.fixture(scope="module")
def settings() -> DeformableSettings:
    return load_settings(Settings, "deformable_collision", "paper", {})


def test_bodies_start_apart_and_within_the_limits(settings: DeformableSettings):
    drop = settings.drop
    for index in range(20):
        low, high = draw_drop(settings, 0, "train", index).vertices
        gaps = (low[:, 2].min(), high[:, 2].min() - low[:, 2].max())
        assert drop.gap_min <= min(gaps) and max(gaps) <= drop.gap_max
        assert high[:, 2].max() <= drop.highest <= settings.workspace_max[2]


def test_bodies_are_rigid_copies_of_their_meshes(settings: DeformableSettings):
    drop = draw_drop(settings, 3, "test", 0)
    for body, points in zip(drop.meshes, drop.vertices, strict=True):
        before = np.linalg.norm(body.vertices[:, None] - body.vertices, axis=-1)
        np.testing.assert_allclose(np.linalg.norm(points[:, None] - points, axis=-1), before, atol=1e-12)


def test_draws_depend_on_seed_split_index_and_attempt_alone(settings: DeformableSettings):
    first = draw_drop(settings, 0, "train", 5)
    again = draw_drop(settings, 0, "train", 5)
    others = [
        draw_drop(settings, 1, "train", 5),
        draw_drop(settings, 0, "validation", 5),
        draw_drop(settings, 0, "train", 6),
        draw_drop(settings, 0, "train", 5, attempt=1),
    ]

    assert first.shapes == again.shapes
    for points, same in zip(first.vertices, again.vertices, strict=True):
        assert (points == same).all()
    starts = {drop.vertices[0].tobytes() for drop in [first, *others]}
    assert len(starts) == 5


def test_all_shapes_come_in_pairs_of_different_ones(settings: DeformableSettings):
    pairs = [draw_drop(settings, 0, "train", index).shapes for index in range(60)]

    assert all(first != second for first, second in pairs)
    for place in (0, 1):
        assert {pair[place] for pair in pairs} == set(settings.bodies.shapes)


def test_small_pools_repeat_their_shapes():
    settings = load_settings(Settings, "deformable_collision", "paper", {"bodies.shapes": ["ball"], "bodies.count": 3})

    assert draw_drop(settings, 0, "train", 0).shapes == ("ball",) * 3


def test_turns_are_uniform():
    """The mean of a uniform random direction is 0 with a spread of sqrt(1/3/n) per axis: 5 sigma."""
    settings = load_settings(Settings, "deformable_block", "paper", {})
    number = 200
    ups = []
    for index in range(number):
        drop = draw_drop(settings, 0, "train", index)
        rest, points = drop.meshes[0].vertices, drop.vertices[0]
        top, bottom = rest[:, 2] == rest[:, 2].max(), rest[:, 2] == rest[:, 2].min()
        ups.append((points[top].mean(axis=0) - points[bottom].mean(axis=0)) / 2)

    assert np.abs(np.mean(ups, axis=0)).max() < 5 * np.sqrt(1 / 3 / number)


def test_impossible_limits_are_told(settings: DeformableSettings):
    low = load_settings(Settings, "deformable_collision", "paper", {"drop.highest": 2.5})
    with pytest.raises(DataError, match=r"stays below drop.highest=2.5 m.\nRaise drop.highest"):
        draw_drop(low, 0, "train", 0)

import copy
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import vpd_lightning as vpd
from tests.editing.scenes import BLUE, FLOOR, RED, two_boxes
from vpd_lightning.editing.edit_files import load_edit, load_scene, replay, save_edit, save_scene
from vpd_lightning.editing.rotation import about_axis
from vpd_lightning.editing.selectors import Box
from vpd_lightning.errors import EditError
from vpd_lightning.simulator import Scene
from vpd_lightning.types import OTHER_AXES, Particles, Scenery

CORNER = Box([-2, -2, -0.1], [-0.5, -0.5, 0.1])
"""A piece of the floor."""

GEOMETRY = ("positions", "normals", "views", "sizes")


def scenery(count=300, seed=0):
    """Points on the floor of ``two_boxes``, the last ten of them padding."""
    generator = torch.Generator().manual_seed(100 + seed)
    flat = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 4.0, 0.0]) - torch.tensor([2.0, 2.0, 0.0])
    unit = torch.nn.functional.normalize
    return Scenery(
        positions=flat[None],
        colors=torch.rand(1, count, 3, generator=generator),
        normals=unit(torch.randn(1, count, 3, generator=generator), dim=-1),
        views=unit(torch.randn(1, count, 3, generator=generator), dim=-1),
        sizes=0.01 + 0.01 * torch.rand(1, count, generator=generator),
        mask=(torch.arange(count) < count - 10)[None],
        occluders=torch.rand(1, 6, 3, generator=generator),
        occluder_mask=torch.tensor([[True] * 4 + [False] * 2]),
        far_mask=(torch.arange(count) >= count - 5)[None],
    )


def scene_with_scenery(seed=0):
    """Return two boxes just above a floor, with scenery in the current frame, and the body of each particle there."""
    scene, _, now = two_boxes(seed)

    def lowered(frame):
        drop = 0.49 * frame.moving[..., None] * torch.tensor([0.0, 0.0, 1.0])
        return replace(frame, positions=frame.positions - drop)

    return Scene(lowered(scene.previous), replace(lowered(scene.current), scenery=scenery(seed=seed))), now


def nearest_of(particles, points):
    """Return the slot of the static particle that lies nearest to each point, by trying them all."""
    still = (particles.mask & ~particles.moving)[0]
    gaps = (points[0][:, None].double() - particles.positions[0].double()).norm(dim=-1)
    return gaps.masked_fill(~still, torch.inf).argmin(dim=1)


def points_of(scene, chosen):
    scenery = scene.current.scenery
    return chosen[nearest_of(scene.current, scenery.positions)][None] & scenery.mask


def equal(one, other):
    return all(torch.equal(getattr(one, item.name), getattr(other, item.name)) for item in fields(Scenery))


@pytest.mark.parametrize("seed", range(3))
def test_deleting_static_particles_takes_the_nearest_scenery_and_nothing_else(seed):
    scene, _ = scene_with_scenery(seed)
    editor = vpd.SceneEditor(scene)
    gone = points_of(scene, editor.select(CORNER))

    edited = editor.delete(CORNER).scene.current.scenery

    assert 10 < int(gone.sum()) < 100
    assert torch.equal(edited.mask, scene.current.scenery.mask & ~gone)
    assert equal(replace(edited, mask=scene.current.scenery.mask), scene.current.scenery)


@pytest.mark.parametrize("body", [RED, BLUE])
def test_editing_a_body_that_moves_leaves_all_scenery(body):
    scene, now = scene_with_scenery()
    editor = vpd.SceneEditor(scene)
    chosen = now == body

    for edited in (
        editor.delete(chosen),
        editor.move(chosen, [0.3, 0.1, 0.0], about_axis([0, 0, 1], 40)),
        editor.scale(chosen, 2.0),
        editor.set_velocity(chosen, [0.1, 0.0, 0.0]),
    ):
        assert equal(edited.scene.current.scenery, scene.current.scenery)
        assert edited.scene.previous.scenery is None


def test_deleting_everything_leaves_no_scenery():
    scene, now = scene_with_scenery()

    edited = vpd.SceneEditor(scene).delete(now >= 0).scene.current.scenery

    assert not edited.mask.any()


def test_static_particles_take_their_scenery_along():
    scene, _ = scene_with_scenery()
    editor = vpd.SceneEditor(scene)
    went = points_of(scene, editor.select(CORNER))[0]
    was = scene.current.scenery

    moved = editor.move(CORNER, [0.5, 0.0, 2.0], about_axis([0, 0, 1], 90), [1.0, -1.0, 0.5]).scene.current.scenery

    x, y, z = (was.positions[0][went] - torch.tensor([1.0, -1.0, 0.5])).unbind(dim=1)
    expected = torch.stack([-y, x, z], dim=1) + torch.tensor([1.5, -1.0, 2.5])  # a quarter turn takes x to y, y to -x
    torch.testing.assert_close(moved.positions[0][went], expected, rtol=0, atol=1e-5)
    for name in ("normals", "views"):
        x, y, z = getattr(was, name)[0][went].unbind(dim=1)
        turned = torch.stack([-y, x, z], dim=1)
        torch.testing.assert_close(getattr(moved, name)[0][went], turned, rtol=0, atol=1e-6)
    assert torch.equal(moved.sizes, was.sizes)
    for name in GEOMETRY:
        assert torch.equal(getattr(moved, name)[0][~went], getattr(was, name)[0][~went]), name
    for name in ("colors", "mask", "occluders", "occluder_mask"):
        assert torch.equal(getattr(moved, name), getattr(was, name)), name


def test_scenery_grows_with_its_particles():
    scene, _ = scene_with_scenery()
    editor = vpd.SceneEditor(scene)
    went = points_of(scene, editor.select(CORNER))[0]
    was, about = scene.current.scenery, torch.tensor([1.0, -1.0, 0.5])

    larger = editor.scale(CORNER, 3.0, about.tolist()).scene.current.scenery

    expected = (was.positions[0][went] - about) * 3 + about
    torch.testing.assert_close(larger.positions[0][went], expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(larger.sizes[0][went], 3 * was.sizes[0][went])
    for name in ("normals", "views"):
        torch.testing.assert_close(getattr(larger, name), getattr(was, name), rtol=0, atol=1e-6)
    for name in GEOMETRY:
        assert torch.equal(getattr(larger, name)[0][~went], getattr(was, name)[0][~went]), name


def test_there_and_back_again_is_the_same_scenery():
    scene, _ = scene_with_scenery()
    editor = vpd.SceneEditor(scene)
    before = copy.deepcopy(scene.current.scenery)
    what, about, axis = editor.select(CORNER), [-1.0, -1.0, 0.0], [0.2, 1.0, 0.3]

    there = editor.move(what, [0.0, 0.0, 9.0]).move(what, rotation=about_axis(axis, 130), about=about)
    there = there.scale(what, 1.7, about)
    back = there.scale(what, 1 / 1.7, about).move(what, rotation=about_axis(axis, -130), about=about)
    back = back.move(what, [0.0, 0.0, -9.0])

    assert (there.scene.current.scenery.positions - before.positions).abs().max() > 5
    for item in fields(Scenery):
        one, other = getattr(back.scene.current.scenery, item.name), getattr(before, item.name)
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)
    assert equal(scene.current.scenery, before)  # an edit changes no tensor that it is given
    assert back.undo().undo().undo().undo().undo().undo().scene.current.scenery is scene.current.scenery


def test_a_copy_of_the_floor_has_its_scenery_and_one_of_a_body_has_none():
    scene, now = scene_with_scenery()
    editor, was = vpd.SceneEditor(scene), scene.current.scenery
    own = points_of(scene, editor.select(CORNER))

    floor = editor.duplicate(CORNER, [0.0, 0.0, 1.5]).scene.current.scenery
    body = editor.duplicate(now == RED, [0.0, 0.0, 1.5]).scene.current.scenery

    names = (*GEOMETRY, "colors", "mask", "far_mask")
    for edited in (floor, body):
        assert equal(replace(edited, **{name: getattr(edited, name)[:, :300] for name in names}), was)
        assert not edited.far_mask[:, 300:].any()  # a copy of a floor brings no second sky
    assert int(floor.mask[:, 300:].sum()) == int(own.sum()) and not body.mask[:, 300:].any()
    copies = floor.positions[:, 300:][floor.mask[:, 300:]]
    expected = was.positions[own] + torch.tensor([0.0, 0.0, 1.5])
    torch.testing.assert_close(copies, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(floor.colors[:, 300:][floor.mask[:, 300:]], was.colors[own])


def test_a_copy_of_a_body_has_no_scenery_either_where_no_particle_stands_still():
    scene, now = scene_with_scenery()
    current = replace(scene.current, moving=torch.ones_like(scene.current.moving))

    edited = vpd.SceneEditor(Scene(scene.previous, current)).duplicate(now == RED, [0.0, 0.0, 1.5])

    shown = edited.scene.current.scenery.mask
    assert int(shown.sum()) == int(current.scenery.mask.sum())


@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
def test_an_inserted_scene_brings_its_scenery(shift):
    scene, _ = scene_with_scenery()
    other, _ = scene_with_scenery(1)

    edited = vpd.SceneEditor(scene).insert(other, None, shift).scene

    merged, brought = edited.current.scenery, other.current.scenery
    assert torch.equal(merged.positions[:, :300], scene.current.scenery.positions)
    there = brought.mask
    expected = (brought.positions + torch.tensor(shift))[there]
    torch.testing.assert_close(merged.positions[:, 300:][there], expected, rtol=0, atol=1e-5)
    assert torch.equal(merged.mask[:, 300:], there) and torch.equal(merged.colors[:, 300:], brought.colors)
    for name in ("occluders", "occluder_mask"):  # what cast the shadows in the first scene's colours
        assert torch.equal(getattr(merged, name), getattr(scene.current.scenery, name))
    assert edited.previous.scenery is None


def test_inserted_points_leave_the_scenery_and_may_be_seen_beside_it():
    scene, _ = scene_with_scenery()
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(2))

    edited = vpd.SceneEditor(scene).insert_points(points, points).scene.current

    assert equal(edited.scenery, scene.current.scenery)
    assert edited.moving[:, -30:].all()


def test_static_particles_of_a_scene_without_scenery_do_not_vanish_in_one_with_it():
    """What stands still is drawn by the scenery alone: without its scenery an inserted floor would not be seen."""
    scene, _ = scene_with_scenery()
    bare, _, now = two_boxes(1)

    try:
        edited = vpd.SceneEditor(scene).insert(bare, None, [0.0, 5.0, 0.0]).scene.current
    except EditError as error:
        assert "scenery" in str(error)
    else:
        inserted = edited.positions[0, -len(now) :][now == FLOOR]
        shown = edited.scenery.positions[0][edited.scenery.mask[0]]
        assert (inserted[:, None] - shown).norm(dim=-1).amin(dim=1).max() < 1.0


def test_a_stored_scene_keeps_its_scenery(tmp_path):
    scene, _ = scene_with_scenery()

    save_scene(tmp_path / "scene.npz", scene)
    loaded = load_scene(tmp_path / "scene.npz")

    assert equal(loaded.current.scenery, scene.current.scenery) and loaded.previous.scenery is None
    for item in fields(Particles):
        if item.name not in (*OTHER_AXES, "pixels"):
            assert torch.equal(getattr(loaded.current, item.name), getattr(scene.current, item.name))
    assert loaded.current.pixels is None, "they are of pictures, which are not stored"
    none_casts = replace(scene.current.scenery, occluders=torch.zeros(1, 0, 3), occluder_mask=torch.zeros(1, 0).bool())
    save_scene(tmp_path / "none.npz", Scene(scene.previous, replace(scene.current, scenery=none_casts)))
    assert equal(load_scene(tmp_path / "none.npz").current.scenery, none_casts)


def test_an_edit_with_an_inserted_scene_does_the_same_again(tmp_path):
    scene, _ = scene_with_scenery()
    other, _ = scene_with_scenery(1)
    editor = vpd.SceneEditor(scene).insert(other, None, [0.0, 5.0, 0.0]).delete(CORNER)

    path = save_edit(tmp_path / "edit.yaml", editor.operations)
    again = replay(scene, load_edit(path))

    assert equal(again.scene.current.scenery, editor.scene.current.scenery)


def test_a_scene_that_was_stored_before_there_were_far_pixels_has_none(tmp_path):
    older = stored(tmp_path)
    assert older.pop("current_scenery_far_mask").any()
    np.savez(tmp_path / "older.npz", **older)

    scenery = load_scene(tmp_path / "older.npz").current.scenery

    assert scenery.far_mask.shape == scenery.mask.shape and not scenery.far_mask.any()


@pytest.mark.parametrize("name", [item.name for item in fields(Scenery) if item.name != "far_mask"])
def test_a_stored_scene_that_lacks_a_part_of_its_scenery_is_refused(tmp_path, name):
    changed = stored(tmp_path)
    del changed[f"current_scenery_{name}"]
    np.savez(tmp_path / "damaged.npz", **changed)

    with pytest.raises(EditError, match=f"lacks current_scenery_{name}"):
        load_scene(tmp_path / "damaged.npz")


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("positions", lambda values: values * np.nan, "current_scenery_positions holds NaN"),
        ("sizes", lambda values: values / 0, "current_scenery_sizes holds NaN or infinity"),
        ("occluders", lambda values: values * np.nan, "current_scenery_occluders holds NaN"),
        ("colors", lambda values: values[:, 1:], r"current_scenery_colors is float32 of shape \(1, 299, 3\)"),
        ("positions", lambda values: values[:, 1:], r"is \w+ of shape \(1, 300"),
        ("views", lambda values: values[..., :2], r"current_scenery_views is float32 of shape \(1, 300, 2\)"),
        ("sizes", lambda values: values[..., None], r"current_scenery_sizes is float32 of shape \(1, 300, 1\)"),
        ("normals", lambda values: values.repeat(2, 0), r"current_scenery_normals is float32 of shape \(2, 300, 3\)"),
        ("mask", lambda values: values.astype(np.float32), "current_scenery_mask is float32"),
        ("normals", lambda values: values.astype(np.int64), "current_scenery_normals is int64"),
        ("occluder_mask", lambda values: values[:, 1:], r"current_scenery_occluder_mask is bool of shape \(1, 5\)"),
        ("positions", lambda values: values[:0], "is no scene"),
        ("occluders", lambda values: np.float32(1.0), "is no scene"),
    ],
)
def test_a_stored_scene_with_damaged_scenery_is_refused(tmp_path, name, change, words):
    changed, key = stored(tmp_path), f"current_scenery_{name}"
    with np.errstate(all="ignore"):
        np.savez(tmp_path / "damaged.npz", **{**changed, key: change(changed[key])})

    with pytest.raises(EditError, match=words):
        load_scene(tmp_path / "damaged.npz")


def stored(folder):
    save_scene(folder / "scene.npz", scene_with_scenery()[0])
    with np.load(folder / "scene.npz") as arrays:
        return dict(arrays)

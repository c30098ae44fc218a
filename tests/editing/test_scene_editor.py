import copy
import math

import pytest
import torch

import vpd_lightning as vpd
from tests.editing.scenes import BLUE, FLOOR, RED, TONES, VELOCITY, same, two_boxes
from tests.work import TensorWork, counted_calls
from vpd_lightning.editing.rotation import about_axis, matrix_of
from vpd_lightning.editing.selectors import Box, Cluster, Color, Everything, Lasso, Sphere
from vpd_lightning.errors import EditError
from vpd_lightning.geometry.cameras import project
from vpd_lightning.types import Cameras


def random_edit(editor, generator):
    """One of the operations with random numbers, on a random half of what is there."""
    chosen = (torch.rand(editor.state.mask.shape, generator=generator) < 0.5) & editor.state.mask
    if not chosen.any():
        chosen = editor.state.mask
    vector = (torch.rand(3, generator=generator) - 0.5).tolist()
    turn = about_axis([0.2, 1.0, 0.3], 100 * vector[0])
    kind = int(torch.randint(7, (1,), generator=generator))
    if kind == 0 and int(editor.state.mask.sum()) > 50:
        return editor.delete(chosen)
    if kind == 1:
        return editor.scale(chosen, 0.5 + abs(vector[0]))
    if kind == 2:
        return editor.duplicate(chosen, vector, turn)
    if kind == 3:
        return editor.set_velocity(chosen, vector, vector)
    if kind == 4:
        return editor.insert(two_boxes(3)[0], Box([-2, -2, 0.2], [2, 2, 2]), vector)
    if kind == 5:
        return editor.insert_points(torch.rand(20, 3, generator=generator), torch.rand(20, 3, generator=generator))
    return editor.move(chosen, vector, turn)


@pytest.mark.parametrize("seed", range(12))
def test_undo_and_redo_restore_every_state_bit_for_bit_and_nothing_is_mutated(seed):
    generator = torch.Generator().manual_seed(seed)
    editor = vpd.SceneEditor(two_boxes(seed)[0])
    editors, kept = [editor], [copy.deepcopy(editor.scene)]
    for _ in range(8):
        editor = random_edit(editor, generator)
        editors.append(editor)
        kept.append(copy.deepcopy(editor.scene))
    for step in range(8, 0, -1):
        assert same(editor.scene, kept[step])
        editor = editor.undo()
    assert same(editor.scene, kept[0]) and not editor.can_undo
    for step in range(1, 9):
        editor = editor.redo()
        assert same(editor.scene, kept[step])
    assert not editor.can_redo and len(editor.operations) == 8
    for one, scene in zip(editors, kept, strict=True):  # later edits left the earlier editors as they were
        assert same(one.scene, scene)


def test_a_new_edit_forgets_what_was_undone():
    editor = vpd.SceneEditor(two_boxes()[0]).delete(Cluster(0)).undo()
    assert editor.can_redo
    editor = editor.delete(Cluster(1))
    assert not editor.can_redo and len(editor.operations) == 1
    with pytest.raises(EditError, match="nothing to redo"):
        editor.redo()
    with pytest.raises(EditError, match="nothing to undo"):
        editor.undo().undo()


@pytest.mark.parametrize("seed", range(6))
def test_numbers_of_selected_deleted_and_duplicated_particles_add_up(seed):
    scene, _, now = two_boxes(seed)
    editor = vpd.SceneEditor(scene)
    total = int(scene.current.mask.sum())
    half = Box([-3, -3, -1], [3, 0, 3])
    chosen, others = int(editor.select(half).sum()), int(editor.select(~half).sum())
    assert chosen + others == total and 0 < chosen < total
    assert int(editor.delete(half).state.mask.sum()) == others
    assert int(editor.duplicate(half).state.mask.sum()) == total + chosen
    assert int(editor.select(half | ~half).sum()) == total
    assert int(editor.select(Everything() - half).sum()) == others
    with pytest.raises(EditError, match="selects none"):
        editor.delete(half & ~half)


@pytest.mark.parametrize("seed", range(6))
def test_moving_and_turning_forth_and_back_is_the_identity_within_a_micrometre(seed):
    scene, _, _ = two_boxes(seed)
    generator = torch.Generator().manual_seed(seed)
    vector, axis = torch.randn(3, generator=generator).tolist(), torch.randn(3, generator=generator).tolist()
    angle = float(360 * torch.rand((), generator=generator))
    editor = vpd.SceneEditor(scene)
    what = editor.select(Cluster(0))
    about = [0.3, -0.2, 0.1]
    there = editor.move(what, vector).move(what, rotation=about_axis(axis, angle), about=about)
    back = there.move(what, rotation=about_axis(axis, -angle), about=about).move(what, [-v for v in vector])
    for frame in ("previous", "current"):
        one, other = getattr(back.scene, frame), getattr(scene, frame)
        assert (one.positions - other.positions).abs().max() < 1e-6
        assert (one.normals - other.normals).abs().max() < 1e-6
    assert (there.scene.current.positions - scene.current.positions).abs().max() > 0.1


def test_history_moves_along_so_that_velocities_turn_with_the_body():
    scene, before, now = two_boxes()
    editor = vpd.SceneEditor(scene)
    turn = about_axis([0, 0, 1], 90)
    edited = editor.move(now == RED, [1.0, 0, 0], turn).scene
    was = scene.current.positions[0][now == RED].mean(0) - scene.previous.positions[0][before == RED].mean(0)
    velocity = edited.current.positions[0][now == RED].mean(0) - edited.previous.positions[0][before == RED].mean(0)
    assert torch.allclose(velocity, matrix_of(turn).float() @ was, atol=1e-5)
    for body in (FLOOR, BLUE):
        assert torch.equal(edited.previous.positions[0][before == body], scene.previous.positions[0][before == body])


def test_normals_turn_with_the_body_in_both_frames_and_no_others_do():
    scene, before, now = two_boxes()
    moved = vpd.SceneEditor(scene).move(now == RED, [1.0, 0.0, 0.0], about_axis([0, 0, 1], 90)).scene
    for frame, body in (("previous", before), ("current", now)):
        was, turned = getattr(scene, frame).normals[0], getattr(moved, frame).normals[0]
        x, y, z = was[body == RED].unbind(dim=1)  # a quarter turn about z takes x to y, and y to -x
        torch.testing.assert_close(turned[body == RED], torch.stack([-y, x, z], dim=1), rtol=0, atol=1e-6)
        assert torch.equal(turned[body != RED], was[body != RED])


@pytest.mark.parametrize("full", [True, False])
def test_a_deleted_body_is_gone_from_both_frames_and_no_other_is(full):
    scene, before, now = two_boxes(full=full)
    colors = None if full else TONES[now.clamp(min=0)]
    previous_colors = None if full else TONES[before.clamp(min=0)]
    edited = vpd.SceneEditor(scene, previous_colors, colors).delete(now == RED).scene
    assert torch.equal(edited.current.mask[0], (now >= 0) & (now != RED))
    assert torch.equal(edited.previous.mask[0], (before >= 0) & (before != RED))


def test_clusters_are_the_bodies_and_not_the_floor():
    for full in (True, False):
        scene, _, now = two_boxes(full=full)
        editor = vpd.SceneEditor(scene)
        assert editor.num_clusters() == 2
        # The one of most particles comes first. A few points of a random cloud lie apart from all others.
        for what, body in ((Cluster(0), RED), (Cluster(nearest=[1.0, 0.2, 0.7]), BLUE)):
            found = editor.select(what)
            assert not bool((found & (now != body)).any())
            assert int(found.sum()) >= 0.95 * int((now == body).sum())
    with pytest.raises(EditError, match="no cluster 2"):
        editor.delete(Cluster(2))


def test_regions_agree_with_plain_loops():
    scene, _, _ = two_boxes()
    editor = vpd.SceneEditor(scene)
    points, mask = scene.current.positions[0], scene.current.mask[0]
    chosen = editor.select(Sphere([0.1, 0.2, 0.0], 0.8))
    box = editor.select(Box([-1, -1, 0.1], [1, 1, 0.7]))
    colored = editor.select(Color([0.9, 0.1, 0.1], 0.2))
    for i, (x, y, z) in enumerate(points.tolist()):
        assert bool(chosen[i]) == (bool(mask[i]) and math.dist((x, y, z), (0.1, 0.2, 0.0)) <= 0.8)
        assert bool(box[i]) == (bool(mask[i]) and -1 <= x <= 1 and -1 <= y <= 1 and 0.1 <= z <= 0.7)
        color = scene.current.colors[0, i].tolist()
        assert bool(colored[i]) == (bool(mask[i]) and math.dist(color, (0.9, 0.1, 0.1)) <= 0.2)


def test_a_lasso_takes_what_the_camera_sees_inside_of_it_and_nothing_behind_the_camera():
    from matplotlib.path import Path

    scene, _, _ = two_boxes()
    intrinsics = torch.tensor([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]])
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looks along +y, z up
    pose[:3, 3] = torch.tensor([0.0, -1.0, 0.6])
    star = [[30, 2], [36, 60], [2, 22], [62, 26], [8, 55]]  # crosses itself
    editor = vpd.SceneEditor(scene)
    chosen = editor.select(Lasso(intrinsics.tolist(), pose.tolist(), star))
    pixels, depth = project(scene.current.positions[0], Cameras(intrinsics, pose, 64, 64))
    ahead = scene.current.mask[0] & (depth > 0)
    winding = Path([*star, star[0]], closed=True).contains_points(pixels.numpy())
    assert int(chosen.sum()) > 3
    assert not bool((chosen & ~ahead).any())
    assert not bool((chosen & ahead & ~torch.from_numpy(winding)).any())  # even-odd is a part of the winding rule
    triangle = [[10, 10], [60, 20], [20, 60]]
    exact = torch.from_numpy(Path([*triangle, triangle[0]], closed=True).contains_points(pixels.numpy())) & ahead
    assert torch.equal(editor.select(Lasso(intrinsics.tolist(), pose.tolist(), triangle)), exact)
    near = editor.select(Lasso(intrinsics.tolist(), pose.tolist(), triangle, max_depth=1.3))
    assert torch.equal(near, exact & (depth <= 1.3))


def test_a_set_velocity_is_exactly_the_motion_between_the_frames():
    scene, before, now = two_boxes()
    editor = vpd.SceneEditor(scene).set_velocity(now == BLUE, [0.3, 0.0, 0.1], [0.0, 0.0, 0.5])
    state = editor.state
    taken = state.mask[state.origin] & (now == BLUE)[state.origin] & state.scene.previous.mask[0]
    assert int(taken.sum()) == int((now == BLUE).sum())
    old = state.scene.previous.positions[0][taken].double()
    new = state.scene.current.positions[0][state.origin[taken]].double()
    center = scene.current.positions[0][now == BLUE].double().mean(0)
    turned = (old - old.mean(0)) @ matrix_of(about_axis([0, 0, 1], math.degrees(0.5))).T + center
    assert torch.allclose(turned, new, atol=1e-6)
    assert torch.allclose(center - old.mean(0), torch.tensor([0.3, 0.0, 0.1], dtype=torch.float64), atol=1e-6)
    others = (before >= 0) & (before != BLUE)
    assert torch.equal(state.scene.previous.positions[0][: len(before)][others], scene.previous.positions[0][others])


def test_scaling_keeps_the_velocity_and_scales_every_distance():
    scene, before, now = two_boxes()
    edited = vpd.SceneEditor(scene).scale(now == RED, 2.0).scene
    was, is_now = scene.current.positions[0][now == RED], edited.current.positions[0][now == RED]
    assert torch.allclose(torch.pdist(is_now), 2 * torch.pdist(was), atol=1e-5)
    shift = edited.current.positions[0][now == RED].mean(0) - edited.previous.positions[0][before == RED].mean(0)
    original = scene.current.positions[0][now == RED].mean(0) - scene.previous.positions[0][before == RED].mean(0)
    assert torch.allclose(shift, original, atol=1e-5) and torch.allclose(original, VELOCITY, atol=0.03)


def test_a_duplicate_is_moved_and_deleted_apart_from_its_original():
    scene, _, now = two_boxes()
    editor = vpd.SceneEditor(scene).duplicate(Cluster(0), [0, -1.5, 0])
    assert editor.num_clusters() == 3
    copy_only = torch.arange(len(editor.state.mask)) >= len(now)
    assert same(editor.delete(copy_only).scene, editor.delete(editor.select(copy_only)).scene)
    assert int(editor.delete(copy_only).scene.previous.mask.sum()) == int(scene.previous.mask.sum())
    only_copy = editor.delete(now_padded(now == RED, editor))
    assert int(only_copy.state.mask[len(now) :].sum()) == int((now == RED).sum())


def now_padded(mask, editor):
    return torch.cat([mask, torch.zeros(len(editor.state.mask) - len(mask), dtype=torch.bool)])


def test_what_does_not_fit_is_refused_by_name():
    scene, _, now = two_boxes()
    editor = vpd.SceneEditor(scene)
    bare = two_boxes(full=False)[0]
    cases = {
        "colors": lambda: editor.insert(bare),
        "no colours": lambda: vpd.SceneEditor(bare).delete(Color([0, 0, 0], 0.1)),
        "mask has shape": lambda: editor.delete(now[:-1] == RED),
        "3 finite numbers": lambda: editor.move(Cluster(0), [0.0, float("nan"), 0.0]),
        "other than zero": lambda: editor.move(Cluster(0), rotation=(0, 0, 0, 0)),
        "no rotation matrix": lambda: editor.move(Cluster(0), rotation=2 * torch.eye(3)),
        "above 0": lambda: editor.scale(Cluster(0), 0.0),
        "must not lie above": lambda: Box([1, 0, 0], [0, 1, 1]),
        "3 or more": lambda: Lasso(torch.eye(3).tolist(), torch.eye(4).tolist(), [[0, 0], [1, 1]]),
        "one of both": lambda: Cluster(),
        "NaN or infinity": lambda: editor.insert_points(torch.full((1, 3), math.inf), torch.zeros(1, 3)),
    }
    for words, act in cases.items():
        with pytest.raises(EditError, match=words):
            act()


def test_ten_thousand_particles_are_selected_at_once():
    from vpd_lightning.simulator import Scene
    from vpd_lightning.types import Particles

    points = torch.rand(1, 10_000, 3, generator=torch.Generator().manual_seed(0))
    frame = Particles(points, torch.zeros(1, 10_000, 4), colors=points)
    editor = vpd.SceneEditor(Scene(frame, frame))
    camera = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]).tolist(), torch.eye(4).tolist()
    polygon = [[50 + 40 * math.cos(a), 50 + 40 * math.sin(a)] for a in range(0, 628, 20)]
    for what in (Box([0, 0, 0], [0.5] * 3), Sphere([0.5] * 3, 0.3), Color([0.5] * 3, 0.3), Lasso(*camera, polygon)):
        with TensorWork() as work, counted_calls() as python:
            assert int(editor.select(what).sum()) > 0
        # A loop over particles would take more calls than there are particles. The polygon has 32 corners: counted here
        # are 332 numbers per particle; the others take 24.
        assert python.calls < 10_000 and work.operations < 500, what
        assert work.numbers < (400 if isinstance(what, Lasso) else 40) * 10_000, what

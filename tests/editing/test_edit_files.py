import os

import numpy as np
import pytest
import torch

import vpd_lightning as vpd
from tests.editing.scenes import RED, same, two_boxes
from vpd_lightning.editing.edit_files import load_edit, load_scene, read_points, replay, save_edit, save_scene
from vpd_lightning.editing.rotation import about_axis
from vpd_lightning.editing.selectors import Box, Cluster, Color, Everything, Lasso, Sphere
from vpd_lightning.errors import EditError
from vpd_lightning.media.ply import write_ply

LASSO = Lasso([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]], torch.eye(4).tolist(), [[0, 0], [64, 0], [64, 64]], 5.0)


def many_edits(scene):
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(1)) + torch.tensor([0.0, 1.0, 0.5])
    colors = (points * 255).round().clamp(0, 255) / 255  # as a PLY file holds them
    return (
        vpd.SceneEditor(scene)
        .move(Cluster(0), [0.1, -0.2, 0.3], about_axis([0, 1, 0], 30), [0, 0, 0.5])
        .duplicate(Color([0.1, 0.2, 0.9], 0.3), [0, 0.7, 0])
        .scale(Sphere([1.0, 0.2, 0.7], 0.5) - Box([0, 0, 0], [0.1, 0.1, 0.1]), 1.5)
        .insert(two_boxes(5)[0], Box([-2, -2, 0.3], [2, 2, 2]), [0.0, 0.5, 0.0])
        .insert_points(points, colors, [0.01, 0.0, 0.0])
        .set_velocity(Cluster(nearest=[0, 1.5, 1.0]), [0, 0.1, 0], [0, 0, 0.2])
        .delete((LASSO & Box([-2, -2, -1], [0, 0, 0.1])) | ~Everything() | Sphere([0.5, 0.5, 0.0], 0.3))
    )


def test_an_edit_that_was_saved_does_the_same_again(tmp_path):
    scene, _, _ = two_boxes()
    editor = many_edits(scene)
    path = save_edit(tmp_path / "edit.yaml", editor.operations)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["edit.yaml", "edit_3.npz", "edit_4.ply"]
    again = replay(scene, load_edit(path))
    assert same(again.scene, editor.scene)
    save_edit(tmp_path / "again.yaml", again.operations)
    text = (tmp_path / "edit.yaml").read_text()
    assert (tmp_path / "again.yaml").read_text() == text.replace("edit_", "again_")
    with pytest.raises(EditError, match="nothing is overwritten"):
        save_edit(path, editor.operations)


def test_an_edit_is_said_of_another_scene_as_well(tmp_path):
    path = tmp_path / "no_red.yaml"
    path.write_text("vpd_edit: 1\nedits:\n- {edit: delete, select: {color: {rgb: [0.9, 0.1, 0.1], tolerance: 0.4}}}\n")
    for seed in (1, 2):
        scene, before, now = two_boxes(seed)
        edited = replay(scene, load_edit(path)).scene
        assert torch.equal(edited.current.mask[0], (now >= 0) & (now != RED))
        assert torch.equal(edited.previous.mask[0], (before >= 0) & (before != RED))


def test_a_mask_cannot_be_stored():
    scene, _, now = two_boxes()
    with pytest.raises(EditError, match="one scene only"):
        save_edit("never.yaml", vpd.SceneEditor(scene).delete(now == RED).operations)


def test_a_rotation_may_be_written_as_axis_and_degrees(tmp_path):
    path = tmp_path / "turn.yaml"
    path.write_text(
        "vpd_edit: 1\nedits: [{edit: move, select: {cluster: {index: 0}}, rotation: {axis: [0, 0, 2], degrees: 90}}]"
    )
    (move,) = load_edit(path)
    assert move.rotation == pytest.approx((0.5**0.5, 0, 0, 0.5**0.5))


def test_an_edit_that_does_not_fit_says_which():
    operations = vpd.SceneEditor(two_boxes()[0]).delete(Cluster(1)).delete(Cluster(0)).operations
    with pytest.raises(EditError, match=r"Edit 2 \(Delete\)"):
        replay(two_boxes()[0], [*operations, operations[0]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no edit"),
        ("[1, 2", "cannot be read"),
        ("vpd_edit: 2\nedits: []", "no edit"),
        ("vpd_edit: 1\nedits: [3]", r"edits\[0\] is 3"),
        ("vpd_edit: 1\nedits: [{edit: delet, select: {everything: }}]", "Did you mean delete"),
        ("vpd_edit: 1\nedits: [{edit: delete}]", "lacks select"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {bx: {}}}]", "Did you mean box"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {box: {low: [0, 0, 0]}}}]", "lacks high"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {box: {low: [0, 0], high: [1, 1, 1]}}}]", "3 finite numbers"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {sphere: {center: [0, 0, 0], radius: x}}}]", "1 finite numbers"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {any_of: []}}]", "list of selections"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: {cluster: {index: true}}}]", "whole number"),
        ("vpd_edit: 1\nedits: [{edit: move, select: {everything: }, rotation: {axis: [0, 0, 1]}}]", "axis and degrees"),
        ("vpd_edit: 1\nedits: [{edit: move, select: {everything: }, rotation: 3}]", "4 finite numbers"),
        ("vpd_edit: 1\nedits: [{edit: move, select: {everything: }, sideways: 3}]", "no 'sideways'"),
        ("vpd_edit: 1\nedits: [{edit: insert, scene: ../secret.npz}]", "beside the edit"),
        ("vpd_edit: 1\nedits: [{edit: insert, scene: /etc/passwd}]", "beside the edit"),
        ("vpd_edit: 1\nedits: [{edit: insert_points}]", "beside the edit"),
        ("vpd_edit: 1\nedits: [{edit: insert_points, points: link.ply}]", "is a link"),
        ("vpd_edit: 1\nedits: [{edit: insert_points, points: missing.ply}]", "cannot be read"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: !!python/object/apply:os.system [id]}]", "cannot be read"),
        ("vpd_edit: 1\nedits: [{edit: delete, select: " + "{not: " * 30 + "{everything: }" + "}" * 30 + "}]", "nested"),
    ],
)
def test_a_wrong_edit_is_refused_by_a_named_error(tmp_path, text, words):
    (tmp_path / "edit.yaml").write_text(text)
    os.symlink("/etc/hostname", tmp_path / "link.ply")
    with pytest.raises(EditError, match=words):
        load_edit(tmp_path / "edit.yaml")


def test_a_missing_or_binary_edit_is_refused(tmp_path):
    with pytest.raises(EditError, match="cannot be read"):
        load_edit(tmp_path / "missing.yaml")
    (tmp_path / "binary.yaml").write_bytes(bytes(range(256)))
    with pytest.raises(EditError, match="cannot be read"):
        load_edit(tmp_path / "binary.yaml")
    (tmp_path / "large.yaml").write_bytes(b"#" * 1_000_001)
    with pytest.raises(EditError, match="that is no edit"):
        load_edit(tmp_path / "large.yaml")


def test_a_stored_scene_is_the_same_and_a_damaged_one_is_refused(tmp_path):
    for full in (True, False):
        scene = two_boxes(full=full)[0]
        path = tmp_path / f"scene_{full}.npz"
        save_scene(path, scene)
        assert same(load_scene(path), scene)
    content = path.read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    np.savez(tmp_path / "pickled.npz", previous_positions=np.array([object()], dtype=object))
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with np.load(path) as arrays:
        changed = dict(arrays)
    np.savez(tmp_path / "nan.npz", **{**changed, "current_positions": changed["current_positions"] * np.nan})
    np.savez(tmp_path / "shape.npz", **{**changed, "current_mask": changed["current_mask"][:, 1:]})
    for name, words in (
        ("cut", "no scene"),
        ("pickled", "no scene"),
        ("other", "lacks previous"),
        ("nan", "NaN"),
        ("shape", "has shapes"),
    ):
        with pytest.raises(EditError, match=words):
            load_scene(tmp_path / f"{name}.npz")


def test_points_are_read_from_ply_and_what_is_none_is_refused(tmp_path):
    generator = np.random.default_rng(0)
    positions, colors = generator.random((50, 3), np.float32), generator.integers(0, 256, (50, 3), np.uint8)
    write_ply(tmp_path / "points.ply", positions, colors)
    read, tones = read_points(tmp_path / "points.ply")
    assert np.array_equal(read.numpy(), positions)
    assert np.array_equal((tones * 255).round().to(torch.uint8).numpy(), colors)
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 99\nend_header\n")
    write_ply(tmp_path / "nan.ply", positions * np.nan, colors)
    for name in ("bad", "nan"):
        with pytest.raises(EditError):
            read_points(tmp_path / f"{name}.ply")

"""MuJoCo's own simulation of an edited scene, where its recording can be simulated anew."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.counterfactual import Change, family_of, run_counterfactual
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.editing.operations import Delete, Move, Operation, SetVelocity
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.viewer.opened_scene import OpenedScene

_WHOLE = 0.9  # so much of a body is all of it: stray particles


def can_simulate(opened: OpenedScene) -> bool:
    """Whether MuJoCo can simulate the recording anew."""
    return opened.manifest is not None and family_of(opened.manifest) is not None


def counterfactual(
    opened: OpenedScene, operations: Sequence[Operation], num_steps: int
) -> UInt8[NDArray, "step view height width 3"] | None:
    """Return what the recorded cameras would have seen, step 0 as edited; None where the edits are none of MuJoCo's.

    Raises:
        DataError: the simulation does not repeat the recording.
    """
    changes = changes_of(opened, operations)
    if changes is None or opened.manifest is None:
        return None
    return run_counterfactual(opened.manifest, opened.path, opened.start + 1, changes, num_steps)


def changes_of(opened: OpenedScene, operations: Sequence[Operation]) -> dict[int, Change] | None:
    """Return what the edits do to the true bodies, by their numbers.

    None where an edit is of something else than whole bodies, or copies or scales them.
    """
    places = dict(enumerate(read_state(opened.path).positions[opened.start + 1]))
    changes: dict[int, Change] = {}
    editor = opened.rollout.editor
    for operation in operations:
        centers = _whole_clusters(editor, operation)
        if centers is None:
            return None
        for center in centers:
            if not places:
                return None
            body = min(places, key=lambda number: float(np.linalg.norm(places[number] - center)))
            change = _change(operation, centers)
            changes[body] = _after(changes.get(body, Change()), change)
            if change.is_gone:
                del places[body]
            else:
                places[body] = change.moved(places[body])
        editor = editor.apply(operation)
    return changes


def _whole_clusters(editor: SceneEditor, operation: Operation) -> list[NDArray[np.float64]] | None:
    """Return the centroids of the object-like clusters that an edit is of; None where it is of anything else."""
    if not isinstance(operation, Delete | Move | SetVelocity):
        return None
    chosen, clusters = editor.select(operation.select), editor.state.clusters
    points, there = editor.state.positions, editor.state.mask
    centers, in_clusters = [], 0
    for number in clusters[chosen & (clusters >= 0)].unique().tolist():
        members = there & (clusters == number)
        if int((members & chosen).sum()) < _WHOLE * int(members.sum()):
            return None
        in_clusters += int((members & chosen).sum())
        centers.append(points[members].double().mean(dim=0).cpu().numpy())
    return centers if centers and in_clusters >= _WHOLE * int(chosen.sum()) else None


def _change(operation: Operation, centers: Sequence[NDArray[np.float64]]) -> Change:
    if isinstance(operation, Delete):
        return Change(is_gone=True)
    if isinstance(operation, SetVelocity):
        return Change(velocity=_numbers(operation.velocity))
    assert isinstance(operation, Move)
    about = np.mean(centers, axis=0) if operation.about is None else operation.about
    return Change(shift=_numbers(operation.translation), turn=_numbers(operation.rotation), about=_numbers(about))


def _after(first: Change, then: Change) -> Change:
    """Return both changes as one."""
    if then.is_gone:
        return then
    turn = Rotation.from_quat(then.turn, scalar_first=True) * Rotation.from_quat(first.turn, scalar_first=True)
    about = np.asarray(first.about)
    velocity = then.velocity
    if velocity is None and first.velocity is not None:
        velocity = _numbers(then.rotation() @ np.asarray(first.velocity))
    return Change(
        shift=_numbers(then.moved(first.moved(about)) - about),
        turn=_numbers(turn.as_quat(scalar_first=True)),
        about=_numbers(about),
        velocity=velocity,
    )


def _numbers(values: object) -> tuple[float, ...]:
    return tuple(float(value) for value in torch.as_tensor(values).flatten().tolist())

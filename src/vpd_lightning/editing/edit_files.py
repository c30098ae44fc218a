"""Edits on disk: a small YAML file, with scenes (NPZ) and points (PLY) beside it where they were inserted."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.editing.operations import Insert, InsertPoints, Operation
from vpd_lightning.editing.plain_edits import operation_from, plain_operation
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.errors import EditError, one_line
from vpd_lightning.files import AtomicPath
from vpd_lightning.media.ply import write_ply
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Particles, Scenery

VERSION = 1
MAX_EDIT_BYTES = 1_000_000
MAX_POINT_BYTES = 100_000_000
MAX_POINTS = 1_000_000


def save_edit(path: str | Path, operations: Sequence[Operation]) -> Path:
    """Write edits as YAML; what was inserted lies beside it, named after it.

    Raises:
        EditError: the file exists, or an edit selects by a mask.
    """
    import yaml

    path = Path(path).expanduser()
    if path.exists():
        raise EditError(f"{path} exists already, and nothing is overwritten.\nGive another name.")
    plain, inserted = [], []
    for number, operation in enumerate(operations):
        files = {}
        if isinstance(operation, Insert):
            files["scene"] = f"{path.stem}_{number}.npz"
        elif isinstance(operation, InsertPoints):
            files["points"] = f"{path.stem}_{number}.ply"
        plain.append(plain_operation(operation, files))
        inserted += [(path.with_name(name), operation) for name in files.values()]
    text = yaml.safe_dump({"vpd_edit": VERSION, "edits": plain}, sort_keys=False, default_flow_style=None)
    path.parent.mkdir(parents=True, exist_ok=True)
    for file, operation in inserted:
        if isinstance(operation, Insert):
            save_scene(file, operation.scene)
        elif isinstance(operation, InsertPoints):
            colors = (operation.colors.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
            write_ply(file, operation.positions.float().cpu().numpy(), colors)
    with AtomicPath(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def load_edit(path: str | Path) -> list[Operation]:
    """Read the edits of a YAML file; nothing outside its folder is opened.

    Raises:
        EditError: the file is missing or is no edit.
    """
    import yaml

    path = Path(path).expanduser()
    try:
        if path.stat().st_size > MAX_EDIT_BYTES:
            raise EditError(f"{path} has more than {MAX_EDIT_BYTES} bytes: that is no edit.")
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise EditError(
            f"{path} cannot be read: {one_line(error)}.\nGive edit=FILE.yaml as SceneEditor saves it."
        ) from error
    if (
        not isinstance(content, dict)
        or content.get("vpd_edit") != VERSION
        or not isinstance(content.get("edits"), list)
    ):
        raise EditError(f"{path} is no edit.\nExpected vpd_edit: {VERSION} and a list of edits.")
    return [_operation(path, number, plain) for number, plain in enumerate(content["edits"])]


def _operation(path: Path, number: int, plain: Any) -> Operation:
    where = f"{path.name}: edits[{number}]"
    tensors: dict[str, Any] = {}
    name = plain.get("edit") if isinstance(plain, dict) else None
    if name == "insert":
        tensors["scene"] = load_scene(_beside(path, plain.get("scene"), f"{where}.scene"))
    elif name == "insert_points":
        tensors["positions"], tensors["colors"] = read_points(_beside(path, plain.get("points"), f"{where}.points"))
    return operation_from(plain, where, tensors)


def _beside(path: Path, name: Any, where: str) -> Path:
    """Return a file in the folder of an edit; an edit may come from anyone and names no others."""
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise EditError(f"{where} is {name!r}.\nExpected the name of a file beside the edit.")
    file = path.parent / name
    if file.is_symlink():
        raise EditError(f"{where}: {name} is a link.\nExpected a plain file beside the edit.")
    return file


def replay(scene: Scene | SceneEditor, operations: Sequence[Operation]) -> SceneEditor:
    """Return an editor behind all edits of a list.

    Raises:
        EditError: one of them does not fit the scene; says which.
    """
    editor = scene if isinstance(scene, SceneEditor) else SceneEditor(scene)
    for number, operation in enumerate(operations):
        try:
            editor = editor.apply(operation)
        except EditError as error:
            raise EditError(f"Edit {number} ({type(operation).__name__}) does not fit this scene.\n{error}") from error
    return editor


def save_scene(path: str | Path, scene: Scene) -> None:
    """Write both frames of a scene as NPZ (float32; batch axis of 1 kept)."""
    arrays = {}
    for frame in ("previous", "current"):
        particles = getattr(scene, frame)
        for item in fields(particles):
            value = getattr(particles, item.name)
            if isinstance(value, Tensor) and item.name != "pixels":  # of pictures, which are not written
                arrays[f"{frame}_{item.name}"] = value.detach().cpu().numpy()
        if (scenery := particles.scenery) is not None:
            for item in fields(scenery):
                arrays[f"{frame}_scenery_{item.name}"] = getattr(scenery, item.name).detach().cpu().numpy()
    with AtomicPath(Path(path)) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def load_scene(path: str | Path) -> Scene:
    """Read a scene that ``save_scene`` wrote; nothing in the file is run.

    Raises:
        EditError: the file is missing, too large, or holds something else.
    """
    path = Path(path)
    _require_size(path)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            frames = [_frame(path, arrays, frame) for frame in ("previous", "current")]
    except EditError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy each have their own
        raise EditError(f"{path} is no scene: {one_line(error)}.\nWrite one with save_scene.") from error
    return Scene(*frames)


def _frame(path: Path, arrays: Any, frame: str) -> Particles:
    kinds = {"positions": "f", "features": "f", "mask": "b", "colors": "f", "moving": "b", "normals": "f"}
    values: dict[str, Tensor] = {}
    for name, kind in kinds.items():
        if f"{frame}_{name}" in arrays:
            array = arrays[f"{frame}_{name}"]
            if array.dtype.kind != kind or array.size > 100 * MAX_POINTS:
                raise EditError(f"{path}: {frame}_{name} is {array.dtype} of shape {array.shape}.")
            if kind == "f" and not np.isfinite(array).all():
                raise EditError(f"{path}: {frame}_{name} holds NaN or infinity.")
            values[name] = torch.from_numpy(array)
    missing = {"positions", "features", "mask"} - set(values)
    if missing:
        raise EditError(f"{path} is no scene: it lacks {frame}_{sorted(missing)[0]}.")
    count = values["positions"].shape[1:2]
    fits = values["positions"].ndim == 3 and values["positions"].shape[::2] == (1, 3)
    for name, value in values.items():
        vector = name in ("positions", "colors", "normals")
        fits &= value.shape[:2] == (1, *count) and value.ndim == (2 if name in ("mask", "moving") else 3)
        fits &= not vector or value.shape[-1] == 3
    if not fits:
        shapes = {name: tuple(value.shape) for name, value in values.items()}
        raise EditError(f"{path} is no scene: the {frame} frame has shapes {shapes}.")
    return Particles(**values, scenery=_scenery(path, arrays, frame))


def _scenery(path: Path, arrays: Any, frame: str) -> Scenery | None:
    """Return the scenery of a frame; None where the file holds none.

    Raises:
        EditError: a part is missing, has another shape, or is not finite.
    """
    names = [item.name for item in fields(Scenery)]
    stored = {name: arrays[key] for name in names if (key := f"{frame}_scenery_{name}") in arrays}
    if not stored:
        return None
    if "far_mask" not in stored and "mask" in stored:  # of versions that had none
        stored["far_mask"] = np.zeros_like(stored["mask"])
    if missing := [name for name in names if name not in stored]:
        raise EditError(f"{path} is no scene: it lacks {frame}_scenery_{missing[0]}.")
    counts = {name: len(stored["occluders" if name.startswith("occluder") else "positions"][0]) for name in names}
    for name, array in stored.items():
        is_flag, is_number = name.endswith("mask"), name == "sizes"
        shape = (1, counts[name]) if is_flag or is_number else (1, counts[name], 3)
        if array.dtype.kind != ("b" if is_flag else "f") or array.shape != shape or array.size > 100 * MAX_POINTS:
            raise EditError(f"{path}: {frame}_scenery_{name} is {array.dtype} of shape {array.shape}.")
        if not is_flag and not np.isfinite(array).all():
            raise EditError(f"{path}: {frame}_scenery_{name} holds NaN or infinity.")
    return Scenery(**{name: torch.from_numpy(array) for name, array in stored.items()})


def read_points(path: str | Path) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"]]:
    """Read a PLY file's points (metres) and colours in [0, 1]; grey where it has none.

    Raises:
        EditError: the file is missing, too large, or holds no points.
    """
    import trimesh

    path = Path(path)
    _require_size(path)
    try:
        with path.open("rb") as stream:
            loaded: Any = trimesh.load(stream, file_type="ply")
        positions = np.asarray(loaded.vertices, dtype=np.float32)
        colors = getattr(loaded, "colors", None)
        if colors is None or len(colors) != len(positions):
            colors = getattr(getattr(loaded, "visual", None), "vertex_colors", None)
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise EditError(f"{path} is no PLY file of points: {one_line(error)}.") from error
    if positions.ndim != 2 or positions.shape[1] != 3 or not 1 <= len(positions) <= MAX_POINTS:
        raise EditError(f"{path} holds {len(positions)} points.\nAllowed: 1 to {MAX_POINTS}.")
    if not np.isfinite(positions).all():
        raise EditError(f"{path} holds points that are NaN or infinite.")
    if colors is None or len(colors) != len(positions):
        colors = np.full((len(positions), 3), 128, np.uint8)
    return torch.from_numpy(positions), torch.from_numpy(np.asarray(colors)[:, :3].astype(np.float32) / 255)


def _require_size(path: Path) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise EditError(f"{path} cannot be read: {error.strerror}.") from error
    if size > MAX_POINT_BYTES:
        raise EditError(f"{path} has {size} bytes.\nAllowed: up to {MAX_POINT_BYTES}.")

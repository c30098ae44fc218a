"""The paper's editing figure and its film: what happens without one body, without the other, and without the floor.

``python -m docs.results.studies.editing_figure CHECKPOINT --data FOLDER`` rolls a scene of Deformable Collision out as
it is and with each object-like cluster deleted, and with all that is no cluster (the scenery) deleted, and writes one
picture: a row for the recording and one for each of these, a column for each shown step, from one camera; and a film,
slowed, of the recording, the prediction and the scene without each body. The edits lie beside them as YAML, for
``vpd-render edit=``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.editing.colored_editor import colored_editor
from vpd_lightning.editing.edit_files import save_edit
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.editing.selectors import AnyOf, Cluster, Everything
from vpd_lightning.errors import ConfigError
from vpd_lightning.files import OutputFolder
from vpd_lightning.loading import load_model
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.video import enlarge, framed, label_bar, write_video
from vpd_lightning.viewer.body_names import body_names
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene
from vpd_lightning.viewer.session import to_uint8

_LABEL_WIDTH = 190
_SIZE = 192
_FILM_SIZE = 224
_FILM_FPS = 8.0


def variants(editor: SceneEditor, kind: str) -> dict[str, SceneEditor]:
    """Return the scene as it is, without each of its clusters, and without its scenery.

    ``kind`` is the generated scene, which says what bodies are called.

    Raises:
        ConfigError: it has no clusters.
    """
    count = editor.num_clusters()
    if count == 0:
        raise ConfigError(
            "This scene has no object-like clusters to delete.\nChoose another trajectory or start frame."
        )
    found = {"predicted, as it is": editor}
    for number, name in enumerate(names_of(editor, kind)):
        found[f"without the {name}"] = editor.delete(Cluster(number))
    bodies = AnyOf(tuple(Cluster(number) for number in range(count)))
    if bool(editor.select(Everything() - bodies).any()):
        found["without the floor"] = editor.delete(Everything() - bodies)
    return found


def names_of(editor: SceneEditor, kind: str) -> list[str]:
    """Return what a person would call each cluster."""
    colors = editor.scene.current.colors
    clusters = torch.where(editor.state.mask, editor.state.clusters, -1).cpu().numpy()
    grey = np.full((len(clusters), 3), 0.5)
    return body_names(kind, clusters, grey if colors is None else colors[0].float().cpu().numpy())


def figure(opened: OpenedScene, editors: dict[str, SceneEditor], steps: Sequence[int], view: int) -> np.ndarray:
    """Return the picture: the recording, then one row per variant; one column per step, from one recorded camera."""
    camera = opened.cameras[view : view + 1]
    blank = np.zeros_like(opened.truth[0, view])
    pictures = {"recorded": [opened.truth[step, view] if step <= opened.num_true_steps else blank for step in steps]}
    for name, editor in editors.items():
        states = [editor.scene.current, *opened.simulator.rollout(editor.scene, max(steps))]
        pictures[name] = [to_uint8(opened.simulator.render([states[step]], camera)[0, 0]) for step in steps]
    rows = []
    for name, images in pictures.items():
        row = np.concatenate([framed(enlarge(image, _SIZE)) for image in images], axis=1)
        rows.append(np.concatenate([label_bar(name, _LABEL_WIDTH, row.shape[0]), row], axis=1))
    each = (rows[0].shape[1] - _LABEL_WIDTH) // len(steps)
    head = [label_bar("", _LABEL_WIDTH), *(label_bar(f"step {step}", each) for step in steps)]
    return np.concatenate([np.concatenate(head, axis=1), *rows])


def film(opened: OpenedScene, editors: dict[str, SceneEditor], num_steps: int, view: int) -> np.ndarray:
    """Return frames: the recording, the prediction and the scene without each body, side by side."""
    num_steps = min(num_steps, opened.num_true_steps)
    camera = opened.cameras[view : view + 1]
    panes = {"recorded": opened.truth[: num_steps + 1, view]}
    for name, editor in editors.items():
        if name != "without the floor":
            states = [editor.scene.current, *opened.simulator.rollout(editor.scene, num_steps)]
            panes[name] = np.stack([to_uint8(opened.simulator.render([state], camera)[0, 0]) for state in states])
    columns = []
    for name, images in panes.items():
        shown = [framed(enlarge(image, _FILM_SIZE)) for image in images]
        columns.append(np.stack([np.concatenate([label_bar(name, image.shape[1]), image]) for image in shown]))
    return np.concatenate(columns, axis=2)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``figure.png``, ``film.webp`` and the edits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="run folder, checkpoint or released model")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--trajectory", type=int, default=0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--steps", type=int, nargs="+", default=[0, 4, 8, 16, 24, 32])
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/editing_figure"))
    options = parser.parse_args(arguments)
    model = load_model(options.checkpoint)
    manifest = load_manifest(options.data)
    path = manifest.split(options.split)[options.trajectory]
    opened = open_scene(model.simulator, path, options.start, model.input_views, model.name)
    editors = variants(colored_editor(model.simulator, opened.scene, opened.viewpoint), manifest.scene)
    with OutputFolder(options.out) as folder:
        write_png(folder / "figure.png", figure(opened, editors, options.steps, options.view))
        write_video(folder / "film.webp", film(opened, editors, max(options.steps), options.view), _FILM_FPS)
        for name, editor in editors.items():
            if editor.operations:
                save_edit(folder / f"{name.replace(' ', '_')}.yaml", editor.operations)
    print(options.out / "figure.png")


if __name__ == "__main__":
    main()

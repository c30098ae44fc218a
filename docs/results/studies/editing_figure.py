"""The paper's editing figure: what happens without one body, without the other, and without the floor.

``python -m docs.results.studies.editing_figure CHECKPOINT --data FOLDER`` rolls a scene of Deformable Collision out as
it is and with each object-like cluster deleted, and with all that is no cluster (the scenery) deleted, and writes one
picture: a row for each, a column for each shown step, from one camera. The edits lie beside it as YAML, for
``vpd-render edit=``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.editing.colored_editor import colored_editor
from vpd_lightning.editing.edit_files import save_edit
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.editing.selectors import AnyOf, Cluster, Everything
from vpd_lightning.errors import ConfigError
from vpd_lightning.files import OutputFolder
from vpd_lightning.loading import load_model
from vpd_lightning.media.pictures import write_png
from vpd_lightning.media.video import enlarge, framed, label_bar
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene
from vpd_lightning.viewer.session import to_uint8

_LABEL_WIDTH = 150


def variants(editor: SceneEditor) -> dict[str, SceneEditor]:
    """Return the scene as it is, without each of its clusters, and without its scenery.

    Raises:
        ConfigError: it has no clusters.
    """
    count = editor.num_clusters()
    if count == 0:
        raise ConfigError(
            "This scene has no object-like clusters to delete.\nChoose another trajectory or start frame."
        )
    found = {"as it is": editor}
    for number in range(count):
        found[f"without body {number}"] = editor.delete(Cluster(number))
    bodies = AnyOf(tuple(Cluster(number) for number in range(count)))
    if bool(editor.select(Everything() - bodies).any()):
        found["without scenery"] = editor.delete(Everything() - bodies)
    return found


def figure(opened: OpenedScene, editors: dict[str, SceneEditor], steps: Sequence[int], view: int) -> np.ndarray:
    """Return the picture: one row per variant, one column per step, from one recorded camera."""
    camera = opened.cameras[view : view + 1]
    rows = []
    for name, editor in editors.items():
        states = [editor.scene.current, *opened.simulator.rollout(editor.scene, max(steps))]
        images = [to_uint8(opened.simulator.render([states[step]], camera)[0, 0]) for step in steps]
        row = np.concatenate([framed(enlarge(image, 192)) for image in images], axis=1)
        rows.append(np.concatenate([label_bar(name, _LABEL_WIDTH, row.shape[0]), row], axis=1))
    each = (rows[0].shape[1] - _LABEL_WIDTH) // len(steps)
    head = [label_bar("", _LABEL_WIDTH), *(label_bar(f"step {step}", each) for step in steps)]
    return np.concatenate([np.concatenate(head, axis=1), *rows])


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``figure.png`` and the edits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="run folder, checkpoint or released model")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="test")
    parser.add_argument("--trajectory", type=int, default=0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--steps", type=int, nargs="+", default=[0, 5, 10, 20, 35, 50])
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/editing_figure"))
    options = parser.parse_args(arguments)
    model = load_model(options.checkpoint)
    path = load_manifest(options.data).split(options.split)[options.trajectory]
    opened = open_scene(model.simulator, path, options.start, model.input_views, model.name)
    editors = variants(colored_editor(model.simulator, opened.scene, opened.viewpoint))
    with OutputFolder(options.out) as folder:
        write_png(folder / "figure.png", figure(opened, editors, options.steps, options.view))
        for name, editor in editors.items():
            if editor.operations:
                save_edit(folder / f"{name.replace(' ', '_')}.yaml", editor.operations)
    print(options.out / "figure.png")


if __name__ == "__main__":
    main()

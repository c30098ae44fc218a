"""The paper's editing figure: what happens without one body, without the other, and without the floor.

``python -m docs.results.studies.editing_figure CHECKPOINT --data FOLDER`` rolls a scene of Deformable Collision out as
it is and with each object-like cluster deleted, and with all that is no cluster (the scenery) deleted, and writes one
picture: a row for the recording and one for each of these, a column for each shown step, from one camera. The edits
lie beside it as YAML, for ``vpd-render edit=``.
"""

import argparse
import colorsys
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

_LABEL_WIDTH = 190
_SIZE = 192
_HUES = ((15, "red"), (45, "orange"), (70, "yellow"), (165, "green"), (255, "blue"), (330, "purple"), (360, "red"))
"""Up to which angle (degrees) of the colour wheel a body is called so."""


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
    found = {"predicted, as it is": editor}
    names = [_named(editor, number) for number in range(count)]
    for number, name in enumerate(names):
        alone = names.count(name) == 1
        found[f"without the {name} body" if alone else f"without {name} body {number}"] = editor.delete(Cluster(number))
    bodies = AnyOf(tuple(Cluster(number) for number in range(count)))
    if bool(editor.select(Everything() - bodies).any()):
        found["without the floor"] = editor.delete(Everything() - bodies)
    return found


def _named(editor: SceneEditor, number: int) -> str:
    """Return what a person would call the mean observed colour of a cluster."""
    colors = editor.scene.current.colors
    if colors is None:
        return "uncoloured"
    red, green, blue = colors[0][editor.select(Cluster(number))].mean(dim=0).tolist()
    hue, saturation, _ = colorsys.rgb_to_hsv(red, green, blue)
    return "grey" if saturation < 0.2 else next(name for end, name in _HUES if 360 * hue <= end)


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Write ``figure.png`` and the edits."""
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

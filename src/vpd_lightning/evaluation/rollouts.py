"""A few predictions as pixels, so that several models can be shown side by side without running them again."""

from pathlib import Path

import numpy as np

from vpd_lightning.evaluation.evaluate import Evaluation
from vpd_lightning.files import AtomicPath

MAX_CLIPS = 2


def write_rollouts(path: Path, evaluation: Evaluation) -> None:
    """Write the first clips as an NPZ file of plain arrays.

    ``clips`` (clip,) are names and ``views`` (view,) numbers of cameras; ``context`` (clip, time, view, height, width,
    3), ``truth`` and ``prediction`` (clip, step, view, height, width, 3) are uint8.
    """
    kept, views = evaluation.kept[:MAX_CLIPS], evaluation.shown_views
    with AtomicPath(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(
            stream,
            allow_pickle=False,
            clips=np.array([clip.name for clip, _ in kept]),
            views=np.array(views),
            context=np.stack([clip.rgb[:, views].numpy() for clip, _ in kept]),
            truth=np.stack([clip.target_rgb[:, views].numpy() for clip, _ in kept]),
            prediction=np.stack([prediction.images_uint8()[:, views] for _, prediction in kept]),
        )

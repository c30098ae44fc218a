"""The program that Blender's Python runs: takes scenes and frames from standard input, answers with pictures.

Runs with ``bpy``, NumPy, OpenEXR and the standard library only. Ends when its input ends, which the death of the
parent brings about. Messages: see ``messages.py``, which lies beside this file.
"""

import os
import shutil
import signal
import sys
import time
import traceback
from typing import Any, BinaryIO

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
# Blender prints to standard output: what belongs to the parent moves away from it before Blender is loaded.
_ANSWERS = os.fdopen(os.dup(1), "wb")
_REQUESTS = os.fdopen(os.dup(0), "rb")
os.dup2(2, 1)
os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
sys.path.append(os.path.dirname(os.path.abspath(__file__)))

import bpy  # type: ignore[import-not-found]  # noqa: E402
import job_scene  # type: ignore[import-not-found]  # noqa: E402
import messages  # type: ignore[import-not-found]  # noqa: E402
import numpy as np  # noqa: E402
import OpenEXR  # type: ignore[import-not-found]  # noqa: E402

_POINT_FILTER = 0.01  # pixels: Blender's smallest; depth and index belong to the pixel's centre
_PICTURE_FILTER = 1.5
_NO_DEPTH = 1e9  # Blender answers 1e10 where there is nothing


class Job:
    """One scene, and how its frames are drawn."""

    def __init__(self, head: dict[str, Any], arrays: dict[str, Any], folder: str) -> None:
        self.head = head
        self.stage = job_scene.BlenderScene(head, arrays, head["width"], head["height"])
        self.path = os.path.join(folder, "view.exr")
        scene = self.stage.scene
        scene.render.engine = "CYCLES"
        scene.render.threads_mode, scene.render.threads = "FIXED", head["threads"]
        scene.render.use_persistent_data = True
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        scene.render.image_settings.color_depth = "32"
        scene.render.image_settings.exr_codec = "NONE"
        cycles = scene.cycles
        cycles.device = "CPU"
        cycles.use_adaptive_sampling = False
        cycles.max_bounces = head["bounces"]
        cycles.diffuse_bounces = cycles.glossy_bounces = head["bounces"]
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.pixel_filter_type = "BLACKMAN_HARRIS"
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        layer = scene.view_layers[0]
        layer.use_pass_z = layer.use_pass_object_index = True
        layer.pass_alpha_threshold = 0.0

    def frame(self, head: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
        """Draw all views of one frame."""
        self.stage.place(arrays)
        shape = (len(self.stage.cameras), self.head["height"], self.head["width"])
        rgb, depth, index = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32), np.empty(shape, np.uint16)
        for view in range(shape[0]):
            self.stage.look_through(view)
            # One ray through the centre of each pixel: depth that is exact, and indices that are not mixed.
            z, number = self._draw(["Depth.Z", "Object Index.X"], 1, _POINT_FILTER, 0, False)
            index[view] = np.rint(number)
            depth[view] = np.where((z < _NO_DEPTH) & (index[view] > 0), z, 0.0)
            color = self._draw(
                ["Combined.R", "Combined.G", "Combined.B"],
                self.head["samples"],
                _PICTURE_FILTER,
                head["seeds"][view],
                self.head["denoise"],
            )
            rgb[view] = _srgb(np.stack(color, axis=-1))
        return {"rgb": rgb, "depth": depth, "index": index}

    def _draw(self, names: list[str], samples: int, width: float, seed: int, denoise: bool) -> list[Any]:
        """Render and return the named channels, top row first."""
        scene, cycles = self.stage.scene, self.stage.scene.cycles
        cycles.samples, cycles.filter_width, cycles.seed, cycles.use_denoising = samples, width, seed, denoise
        scene.render.filepath = self.path
        bpy.ops.render.render(write_still=True)
        with OpenEXR.File(self.path, separate_channels=True) as file:
            channels = {name: part.channels[name].pixels for part in file.parts for name in part.channels}
            return [np.array(channels[f"{scene.view_layers[0].name}.{name}"]) for name in names]


def _srgb(linear: Any) -> Any:
    """Encode as sRGB bytes: Blender's ``Standard`` view without its dither."""
    values = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * encoded).astype(np.uint8)


def _exactly(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise EOFError
    return data


def _answer(head: dict[str, Any], arrays: dict[str, Any]) -> None:
    _ANSWERS.write(messages.pack(head, arrays))
    _ANSWERS.flush()


def main() -> None:
    """Serve requests until the input ends."""
    job: Job | None = None
    folder = sys.argv[1]
    try:
        _answer({"kind": "ready", "blender": bpy.app.version_string}, {})
        while True:
            try:
                head, arrays = messages.unpack(lambda count: _exactly(_REQUESTS, count))
            except EOFError:
                return
            try:
                start = time.perf_counter()
                if head["kind"] == "scene":
                    job = Job(head, arrays, folder)
                    answer: dict[str, Any] = {}
                elif job is None:
                    raise RuntimeError("a frame came before any scene")
                else:
                    answer = job.frame(head, arrays)
                _answer({"kind": "done", "seconds": time.perf_counter() - start}, answer)
            except Exception as error:  # the parent shows it; the next scene may work
                traceback.print_exc()
                _answer({"kind": "error", "message": f"{type(error).__name__}: {error}"}, {})
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()

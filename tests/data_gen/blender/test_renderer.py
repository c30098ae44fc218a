"""Pictures by Blender itself, where its environment is there (`make blender`)."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from data_gen.blender import process
from data_gen.blender.renderer import BlenderRenderer
from data_gen.cameras import camera_intrinsics, camera_poses
from tests.data_gen.blender.small_scene import BOX_HALF, BOX_POSITION, CAMERA, missing_blender, pictures, small_scene
from tests.waiting import HANG, wait_until
from vpd_lightning.errors import RenderingBackendError

ROOT = Path(__file__).resolve().parents[3]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(missing_blender() is not None, reason=str(missing_blender())),
]


@pytest.fixture(scope="module")
def rendered():
    model, data, labels = small_scene()
    renderer = BlenderRenderer(model, CAMERA, labels, samples=4)
    images = pictures()
    renderer.render(data, *images)
    return model, data, labels, images


def rays():
    """Return origins (view, 3) and directions (view, height, width, 3) with z = 1 in the camera."""
    column, row = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
    local = np.einsum("vij,hwj->vhwi", np.linalg.inv(camera_intrinsics(CAMERA)), pixels)
    poses = camera_poses(CAMERA)
    return poses[:, :3, 3], np.einsum("vij,vhwj->vhwi", poses[:, :3, :3], local)


def test_depth_lies_on_the_plane_and_on_the_box(rendered):
    """1e-5 m: float32 at 3 m, and a ray at most 0.005 pixels beside the centre of its pixel."""
    model, _, _, (_, depth, segmentation) = rendered
    origins, directions = rays()
    points = origins[:, None, None] + directions * depth[..., None]
    floor = segmentation == model.geom("floor").id + 1
    assert floor.mean() > 0.3
    assert np.abs(points[floor][:, 2]).max() < 1e-5
    box = segmentation == model.geom("box").id + 1
    assert box.sum() > 100
    outside = np.abs(points[box] - BOX_POSITION) - BOX_HALF
    assert np.abs(outside.max(axis=1)).max() < 1e-5


def test_silhouettes_and_depth_equal_mujocos_own_rays(rendered):
    """An independent reference that knows exact spheres, cylinders and capsules, and no pictures."""
    model, data, _, (_, depth, segmentation) = rendered
    origins, directions = rays()
    shown = np.zeros(6, np.uint8)
    shown[:3] = 1
    expected, distance = np.zeros(depth.shape, int), np.zeros(depth.shape)
    hit = np.zeros(1, np.int32)
    for index in np.ndindex(depth.shape):
        ray = directions[index]
        length = mujoco.mj_ray(model, data, origins[index[0]], ray, shown, 1, -1, hit)
        expected[index], distance[index] = hit[0] + 1, max(length, 0.0)
    body = (segmentation != 101) & (expected > 0)  # rays pass through the flex
    differ = body & (segmentation != expected)
    assert differ.mean() < 2e-3  # centres of pixels that lie on an edge
    # None further than one pixel from an edge of the reference.
    for view, row, column in np.argwhere(differ):
        around = expected[view, max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        assert segmentation[view, row, column] in around
    same = body & ~differ
    error = np.abs(depth - distance)[same]
    assert np.quantile(error, 0.95) < 1e-4  # flat faces; facets of round shapes lie up to 0.05 % of the radius inside
    assert np.quantile(error, 0.995) < 3e-3
    nothing = (expected == 0) & (segmentation == 0)
    assert nothing.any() and (depth[nothing] == 0).all()


def test_same_state_gives_the_same_bytes_in_another_process_and_after_another_state(rendered):
    model, data, labels, images = rendered
    process.shared_process().close()  # the next one is fresh
    renderer = BlenderRenderer(model, CAMERA, labels, samples=4)
    moved = mujoco.MjData(model)
    moved.qpos[:] = data.qpos
    moved.qpos[:3] += 0.1
    mujoco.mj_forward(model, moved)
    other, again = pictures(), pictures()
    renderer.render(moved, *other)
    renderer.render(data, *again)
    for first, second in zip(images, again, strict=True):
        assert np.array_equal(first, second)
    assert (other[2] != images[2]).any()


def test_two_scenes_take_turns(rendered):
    model, data, labels, images = rendered
    first = BlenderRenderer(model, CAMERA, labels, samples=4)
    other_model, other_data, other_labels = small_scene('<geom type="sphere" size=".3" pos="0 0 1"/>')
    second = BlenderRenderer(other_model, CAMERA, other_labels, samples=4)
    different, again = pictures(), pictures()
    second.render(other_data, *different)
    first.render(data, *again)
    assert np.array_equal(again[0], images[0])
    assert (different[2] != images[2]).any()


def test_crash_gives_an_error_and_the_next_picture_a_new_blender(rendered):
    model, data, labels, images = rendered
    renderer = BlenderRenderer(model, CAMERA, labels, samples=4)
    killed = process.shared_process()
    os.kill(killed.pid, signal.SIGKILL)
    again = pictures()
    with pytest.raises(RenderingBackendError, match="Blender's process ended during: frame"):
        killed.ask({"kind": "frame", "seeds": [0, 0]}, {}, timeout=HANG)
    renderer.render(data, *again)
    assert np.array_equal(again[0], images[0])


def test_blender_ends_when_its_parent_is_killed():
    code = """
import sys, time
from data_gen.blender.process import shared_process
print(shared_process().pid, flush=True)
time.sleep(600)
"""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    parent = subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, cwd=ROOT)
    assert parent.stdout
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    stat = Path(f"/proc/{child}/stat")
    wait_until(lambda: not stat.exists() or "Z" in stat.read_text().split(")")[1][:3])  # else it outlives its parent


def test_floor_in_the_light_is_as_bright_as_in_gl(rendered):
    """A flat white floor: ambient 0.35 plus 0.6 times the slope of the light, in sRGB."""
    model, data, labels = small_scene()
    texture = model.texture("flat")
    model.tex_data[int(texture.adr[0]) :][: 32 * 64 * 3] = 200
    renderer = BlenderRenderer(model, CAMERA, labels, samples=16)
    rgb, depth, segmentation = pictures()
    renderer.render(data, rgb, depth, segmentation)
    lit = 200 * (0.35 + 0.6 / np.linalg.norm([0.4, 0.3, 1.0]))
    floor = rgb[segmentation == model.geom("floor").id + 1]
    assert np.median(floor) == pytest.approx(lit, abs=6)  # bounced light, gloss, and things that hide the sky


@pytest.mark.gl
def test_pictures_equal_gl_in_depth_and_outline_and_resemble_it_in_colour(rendered, tmp_path: Path):
    """GL runs in a process of its own, because its backend is chosen before MuJoCo is imported."""
    from data_gen.gl_backend import working_backend

    code = f"""
import numpy as np
from data_gen.gl import GLRenderer
from tests.data_gen.blender.small_scene import CAMERA, pictures, small_scene
model, data, labels = small_scene()
renderer = GLRenderer(model, CAMERA, labels, "egl")
images = pictures()
renderer.render(data, *images)
renderer.close()
np.savez({str(tmp_path / "gl.npz")!r}, *images)
"""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "MUJOCO_GL": str(working_backend())}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, cwd=ROOT)
    with np.load(tmp_path / "gl.npz") as stored:
        gl_rgb, gl_depth, gl_segmentation = (stored[f"arr_{i}"] for i in range(3))
    _, _, _, (rgb, depth, segmentation) = rendered
    same = segmentation == gl_segmentation
    assert same.mean() > 0.998
    for view, row, column in np.argwhere(~same):
        around = gl_segmentation[view, max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        assert segmentation[view, row, column] in around
    flat = same & np.isin(segmentation, [1, 2, 6, 101])  # floor, box, wedge, flex: the same triangles
    assert np.abs(depth - gl_depth)[flat].max() < 1e-5
    assert (segmentation == 101).sum() > 100
    assert np.abs(rgb.astype(int) - gl_rgb)[same].mean() < 15  # light falls off differently; textures sit alike

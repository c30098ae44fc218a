"""Make a recording as somebody with three depth cameras over a table would: images, 16-bit depth, ``cameras.json``.

``python examples/make_recording.py recordings/table``. A stick pushes a box and a cylinder across a table at constant
speed, in 20 takes. The cameras are off centre, one has a distorting lens, and depth has the errors of a structured-
light sensor: noise of 0.35 % at the table, holes, pixels in the air at edges. Nothing here writes our data format;
``vpd-data import`` reads what comes out (docs/your_data.md). Needs GL, as ``vpd-data generate`` does: EGL, or
``MUJOCO_GL=osmesa``.
"""

import argparse
import json
import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.sensors import Sensor, load_sensor

HEIGHT, WIDTH, FOCAL = 96, 128, 120.0
FRAME_TIME, STEPS_PER_FRAME = 0.05, 25
SPEED = 0.2  # m/s, of the stick
REACH = 5.0  # m, of the depth sensors
NOISE = 0.35  # percent of the depth at the table
LARGE = 2  # the simulated pictures are larger and finer than the cameras', which look at parts of them
SCENE = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <visual><global offwidth="512" offheight="384"/><map znear="0.01" zfar="20"/><quality shadowsize="2048"/></visual>
  <asset>
    <texture name="wood" type="2d" builtin="checker" rgb1="0.72 0.6 0.45" rgb2="0.66 0.54 0.4" width="64" height="64"/>
    <material name="wood" texture="wood" texrepeat="6 6"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="0.35 0.37 0.4" rgb2="0.3 0.32 0.35" width="64" height="64"/>
    <material name="tiles" texture="tiles" texrepeat="12 12"/>
  </asset>
  <worldbody>
    <light pos="0.5 -0.4 2" dir="-0.25 0.2 -1" diffuse="0.7 0.7 0.7"/>
    <geom type="plane" size="4 4 0.1" pos="0 0 -0.7" material="tiles"/>
    <geom type="box" size="0.5 0.4 0.02" pos="0 0 -0.02" material="wood" friction="0.5"/>
    <body name="box" pos="0 0 0.045"><freejoint/>
      <geom type="box" size="0.05 0.04 0.045" mass="0.3" rgba="0.8 0.2 0.15 1" friction="0.5"/></body>
    <body name="cylinder" pos="0.1 0.1 0.06"><freejoint/>
      <geom type="cylinder" size="0.035 0.06" mass="0.2" rgba="0.15 0.35 0.75 1" friction="0.5"/></body>
    <body name="stick" mocap="true" pos="-0.3 0 0.16">
      <geom type="capsule" size="0.012 0.14" rgba="0.9 0.8 0.2 1"/></body>
    {cameras}
  </worldbody>
</mujoco>
"""
PLACES = {"left": (-0.75, -0.75, 0.85), "right": (0.85, -0.6, 0.75), "back": (0.1, 0.95, 0.9)}  # m
OFFSETS = {"left": (5.0, -3.0), "right": (-4.0, 2.0), "back": (3.0, 4.0)}  # pixels, of the principal points
LENS = {"back": np.array([-0.12, 0.03, 0.001, -0.001, 0.0])}  # OpenCV's k1 k2 p1 p2 k3


def world_to_cam(name: str) -> NDArray[np.float64]:
    """Pose as ``solvePnP`` gives it: x right, y down, z forward; all cameras look at the table's middle."""
    position = np.array(PLACES[name])
    forward = np.array([0.0, 0.0, 0.03]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def large_pixels(name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where the pixels of a camera lie in its large picture: columns and rows, centres at whole numbers."""
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    dx, dy = OFFSETS[name]
    seen = np.stack([(u - WIDTH / 2 - dx) / FOCAL, (v - HEIGHT / 2 - dy) / FOCAL], axis=-1)
    rays = seen
    if name in LENS:
        rays = cv2.undistortPoints(seen.reshape(-1, 1, 2), np.eye(3), LENS[name]).reshape(seen.shape)
    columns = LARGE * (FOCAL * rays[..., 0] + WIDTH) - 0.5
    rows = LARGE * (FOCAL * rays[..., 1] + HEIGHT) - 0.5
    return columns.astype(np.float32), rows.astype(np.float32)


def calibration() -> dict[str, object]:
    """What the calibration found: the content of ``cameras.json``."""
    views = []
    for name, (dx, dy) in OFFSETS.items():
        # As OpenCV counts: the first pixel's centre is 0.
        view = {"name": name, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2 + dx - 0.5, "cy": HEIGHT / 2 + dy - 0.5}
        lens = {"distortion": LENS[name].tolist()} if name in LENS else {}
        views.append({**view, **lens, "world_to_cam": world_to_cam(name).tolist()})
    return {
        "frame_time": FRAME_TIME,
        "axes": "opencv",
        "pixel_center": 0.0,
        "depth_type": "z",
        "depth_unit": 0.001,
        "views": views,
    }


def camera_elements() -> str:
    """MuJoCo's cameras: x right, y up, looking along -z."""
    field = 2 * np.degrees(np.arctan(HEIGHT / FOCAL))  # the large pictures see twice as much
    lines = []
    for name, position in PLACES.items():
        right, down, _ = world_to_cam(name)[:3, :3]
        axes = " ".join(f"{value:.9f}" for value in (*right, *-down))
        place = " ".join(map(str, position))
        lines.append(f'<camera name="{name}" pos="{place}" xyaxes="{axes}" fovy="{field:.9f}"/>')
    return "\n    ".join(lines)


def start(model: mujoco.MjModel, rng: np.random.Generator) -> tuple[mujoco.MjData, NDArray[np.float64]]:
    """Place the bodies at random, and the stick behind one of them; return the state and the stick's velocity."""
    data = mujoco.MjData(model)
    angle = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    across = np.array([-way[1], way[0], 0.0])
    for number, (name, height) in enumerate((("box", 0.045), ("cylinder", 0.06))):
        turn = rng.uniform(0, 2 * np.pi)
        place = -0.05 * way + number * (0.13 * way + rng.uniform(-0.05, 0.05) * across) + rng.uniform(-0.02, 0.02, 3)
        first = model.joint(model.body(name).jntadr[0]).qposadr[0]
        data.qpos[first : first + 7] = [*place[:2], height, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]
    data.mocap_pos[0] = -0.17 * way + rng.uniform(-0.02, 0.02) * across + [0.0, 0.0, 0.16]
    mujoco.mj_forward(model, data)
    return data, SPEED * way


def record(folder: Path, model: mujoco.MjModel, renderer: mujoco.Renderer, seed: int, num_frames: int) -> None:
    """Write one take."""
    data, velocity = start(model, np.random.default_rng(seed))
    settings = load_sensor("structured_light", {"percent_at_median": NOISE})
    sensor = Sensor(settings, seed=0, trajectory=folder.name, median_depth=1.1)
    for name in PLACES:
        for kind in ("rgb", "depth"):
            (folder / name / kind).mkdir(parents=True, exist_ok=True)
    matrix = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    for frame in range(num_frames):
        for view, name in enumerate(PLACES):
            renderer.update_scene(data, name)
            columns, rows = large_pixels(name)
            picture = cv2.remap(renderer.render(), columns, rows, cv2.INTER_LINEAR)
            renderer.enable_depth_rendering()
            true = cv2.remap(renderer.render(), columns, rows, cv2.INTER_NEAREST)
            renderer.disable_depth_rendering()
            depth = sensor.measure_depth(np.where(true < REACH, true, 0), matrix, frame, view)
            stem = f"{frame:06d}.png"
            cv2.imwrite(str(folder / name / "rgb" / stem), sensor.measure_rgb(picture, frame, view)[..., ::-1])
            cv2.imwrite(str(folder / name / "depth" / stem), np.rint(1000 * depth).astype(np.uint16))
        for _ in range(STEPS_PER_FRAME):
            data.mocap_pos[0] += velocity * model.opt.timestep
            mujoco.mj_step(model, data)
    (folder / "cameras.json").write_text(json.dumps(calibration(), indent=1) + "\n")


def main() -> None:
    """Record all takes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--takes", type=int, default=20)
    parser.add_argument("--frames", type=int, default=32)
    options = parser.parse_args()
    model = mujoco.MjModel.from_xml_string(SCENE.format(cameras=camera_elements()))
    with mujoco.Renderer(model, 2 * LARGE * HEIGHT, 2 * LARGE * WIDTH) as renderer:
        for take in range(options.takes):
            record(options.out / f"take{take:02d}", model, renderer, take, options.frames)
            print(f"{options.out / f'take{take:02d}'}: {options.frames} frames of {len(PLACES)} cameras", flush=True)


if __name__ == "__main__":
    main()

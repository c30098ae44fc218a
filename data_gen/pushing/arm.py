"""What moves the pusher: nothing but its own two axes, or a small arm that turns about upright ones (a SCARA).

All is a function of the two joints: places x and y of the pusher (m), or angles of shoulder and elbow (rad).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.cameras import mjcf_numbers
from data_gen.pushing.settings import PusherSettings, PushingSettings

Array = NDArray[np.float64]

PUSHER = "pusher"
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
ROLLING = "0.005 0.0005"  # torsional and rolling friction, m: balls come to rest on the table


def joints_of(settings: PushingSettings, place: Array) -> Array:
    """Return the joints (2,) that bring the pusher to a place (2,), metres; the elbow is always bent to one side."""
    if not settings.arm.links:
        return place
    upper, fore = settings.arm.links
    way = place - np.asarray(settings.arm.base)
    bend = np.arccos(np.clip((way @ way - upper**2 - fore**2) / (2 * upper * fore), -1.0, 1.0))
    return np.array([np.arctan2(way[1], way[0]) - np.arctan2(fore * np.sin(bend), upper + fore * np.cos(bend)), bend])


def place_of(settings: PushingSettings, joints: Array) -> Array:
    """Return where the pusher is (2,), metres."""
    return link_poses(settings, joints)[-1, :2, 3]


def link_poses(settings: PushingSettings, joints: Array) -> Array:
    """Return the pose of each link in the world (link, 4, 4): column, upper arm, forearm, if any; then the pusher."""
    pusher = np.eye(4)
    if not settings.arm.links:
        pusher[:3, 3] = [*joints, settings.pusher_height]
        return pusher[None]
    upper, fore = settings.arm.links
    column, first, second = np.eye(4), _turned(joints[0]), _turned(joints[0] + joints[1])
    column[:3, 3] = [*settings.arm.base, _column_middle(settings)]
    first[:3, 3] = [*settings.arm.base, settings.arm_height]
    second[:3, 3] = first[:3, 3] + upper * first[:3, 0]
    pusher = second.copy()
    pusher[:3, 3] += fore * second[:3, 0]
    pusher[2, 3] = settings.pusher_height
    return np.stack([column, first, second, pusher])


def link_surfaces(settings: PushingSettings) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int32]]:
    """Return points and outward normals (point, 3) in the frames of their links, metres, and the link of each."""
    pusher, arm = settings.pusher, settings.arm
    parts = [cylinder_surface(pusher.radius, pusher.length, pusher.num_points)]
    if arm.links:
        along = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # an upright cylinder's axis becomes x
        lying = []
        for length in arm.links:
            points, normals = cylinder_surface(arm.radius, length, arm.num_points)
            lying.append((points @ along.T + [length / 2, 0, 0], normals @ along.T))
        upright = cylinder_surface(arm.radius, settings.arm_height + settings.table.height, arm.num_points)
        parts = [upright, *lying, *parts]
    groups = np.repeat(np.arange(len(parts), dtype=np.int32), [len(points) for points, _ in parts])
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts]), groups


def cylinder_surface(radius: float, length: float, num_points: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Spread points evenly over an upright cylinder: points and outward normals (point, 3), from its middle, metres."""
    half = length / 2
    side, cap = 2 * half, radius / 2  # areas over 2 pi radius
    num_caps = round(num_points * cap / (side + 2 * cap))
    num_side = num_points - 2 * num_caps
    index = np.arange(num_side) + 0.5
    angle = index * _GOLDEN_ANGLE
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(num_side)], axis=1)
    points, normals = [outward * radius + [[0, 0, 1]] * (half * (2 * index / num_side - 1))[:, None]], [outward]
    for sign in (-1.0, 1.0):
        index = np.arange(num_caps) + 0.5
        away, angle = radius * np.sqrt(index / max(num_caps, 1)), index * _GOLDEN_ANGLE
        points.append(np.stack([away * np.cos(angle), away * np.sin(angle), np.full(num_caps, sign * half)], axis=1))
        normals.append(np.tile([0.0, 0.0, sign], (num_caps, 1)))
    return np.concatenate(points), np.concatenate(normals)


def tool_xml(settings: PushingSettings) -> str:
    """Return the MJCF of the pusher and of what carries it; links touch nothing, they are above all bodies."""
    pusher, arm = settings.pusher, settings.arm
    geom = (
        f'<geom name="{PUSHER}" type="cylinder" size="{pusher.radius!r} {pusher.length / 2!r}" mass="{pusher.mass!r}"'
        f' material="{PUSHER}" friction="{pusher.friction!r} {ROLLING}"/>'
    )
    if not arm.links:
        return f"""
    <body name="{PUSHER}" pos="0 0 {settings.pusher_height!r}" gravcomp="1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      {geom}
    </body>"""
    upper, fore = arm.links
    base = mjcf_numbers(arm.base)
    half = (settings.arm_height + settings.table.height) / 2
    down = settings.pusher_height - settings.arm_height
    ghost = f'mass="{arm.mass!r}" material="arm" contype="0" conaffinity="0"'
    return f"""
    <body name="column" pos="{base} {_column_middle(settings)!r}">
      <geom type="cylinder" size="{arm.radius!r} {half!r}" {ghost}/>
    </body>
    <body name="upper" pos="{base} {settings.arm_height!r}" gravcomp="1">
      <joint name="x" type="hinge" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 {upper!r} 0 0" size="{arm.radius!r}" {ghost}/>
      <body name="fore" pos="{upper!r} 0 0" gravcomp="1">
        <joint name="y" type="hinge" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 {fore!r} 0 0" size="{arm.radius!r}" {ghost}/>
        <body name="{PUSHER}" pos="{fore!r} 0 {down!r}" gravcomp="1">{geom}</body>
      </body>
    </body>"""


def controls_xml(settings: PushingSettings) -> str:
    """Return the MJCF of the position control of both joints; an arm's is as stiff at the pusher, stretched out."""
    pusher: PusherSettings = settings.pusher
    scales = [sum(settings.arm.links), settings.arm.links[1]] if settings.arm.links else [1.0, 1.0]
    return "".join(
        f'<position name="{name}" joint="{name}" kp="{pusher.stiffness * scale**2!r}"'
        f' kv="{pusher.damping * scale**2!r}"'
        f' forcerange="{-pusher.max_force * scale!r} {pusher.max_force * scale!r}"/>'
        for name, scale in zip("xy", scales, strict=True)
    )


def _column_middle(settings: PushingSettings) -> float:
    return (settings.arm_height - settings.table.height) / 2


def _turned(angle: float) -> Array:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose

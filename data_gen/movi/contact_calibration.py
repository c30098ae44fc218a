"""Measures how spheres bounce and slide in MuJoCo, to fill and to check the table in ``data_gen.movi.contacts``.

``python -m data_gen.movi.contact_calibration`` prints the table for the installed MuJoCo.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from data_gen.movi.contacts import CALIBRATED_TIMESTEP, IMPEDANCE, contact_time_constant, option_xml

DAMPING_RATIOS = (0.03, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.2, 1.5)
SPEEDS = (2.0, 4.0, 8.0)  # m/s at the impact
NUM_PHASES = 8  # moments between two steps at which the impact begins
_RADIUS = 0.5  # m
_LONGEST_IMPACT = 0.4  # s


def measure_restitution(
    damping_ratio: float, speeds: Sequence[float] = SPEEDS, num_phases: int = NUM_PHASES
) -> tuple[float, float]:
    """Drop a sphere onto a plane; return mean and largest deviation of (speed after) / (speed before) the impact."""
    solref = f"{contact_time_constant(damping_ratio)!r} {damping_ratio!r}"
    pair = f'<pair geom1="floor" geom2="ball" condim="3" solref="{solref}" solimp="{" ".join(map(repr, IMPEDANCE))}"/>'
    found = np.array([bounce(pair, speed, (i + 0.5) / num_phases) for speed in speeds for i in range(num_phases)])
    return float(found.mean()), float(np.abs(found - found.mean()).max())


def bounce(pair: str, speed: float, phase: float = 0.5) -> float:
    """Drop a sphere ``ball`` onto a plane ``floor``, whose ``<pair>`` is given; return the restitution.

    Args:
        pair: MJCF element of the contact.
        speed: m/s, downwards, at the impact.
        phase: 0 to 1, the part of a physics step from the start until the sphere touches.
    """
    import mujoco

    model = _model(pair)
    data = mujoco.MjData(model)
    data.qpos[2] = _RADIUS + phase * speed * model.opt.timestep
    data.qvel[2] = -speed
    has_touched = False
    for _ in range(round(_LONGEST_IMPACT / model.opt.timestep)):
        mujoco.mj_step(model, data)
        if data.ncon:
            has_touched = True
        elif has_touched:
            return float(data.qvel[2] / speed)
    return 0.0  # it has come to rest


def slide(pair: str, speed: float, duration: float) -> float:
    """Slide a box ``ball`` over a plane ``floor``; return its mean deceleration in m/s^2.

    Args:
        pair: MJCF element of the contact.
        speed: m/s, diagonal to the world's axes, at the start.
        duration: s, shorter than what the box needs to stop.
    """
    import mujoco

    model = _model(pair, kind='type="box" size="0.5 0.5 0.05"')
    data = mujoco.MjData(model)
    data.qpos[2] = 0.05
    mujoco.mj_step(model, data, round(0.2 / model.opt.timestep))  # settles
    data.qvel[:2] = speed * np.sqrt(0.5)
    mujoco.mj_step(model, data, round(duration / model.opt.timestep))
    return float((speed - np.linalg.norm(data.qvel[:2])) / duration)


def _model(pair: str, kind: str = f'type="sphere" size="{_RADIUS!r}"') -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string(f"""
<mujoco>
  {option_xml(CALIBRATED_TIMESTEP)}
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1"/>
    <body><freejoint/><geom name="ball" {kind} density="1"/></body>
  </worldbody>
  <contact>{pair}</contact>
</mujoco>""")


def main() -> None:
    """Print the table."""
    for ratio in DAMPING_RATIOS:
        mean, deviation = measure_restitution(ratio)
        print(f"    ({ratio}, {mean:.4f}),  # +- {deviation:.3f}")


if __name__ == "__main__":
    main()

"""Contacts between bodies as Bullet (Kubric's engine) has them, expressed in MuJoCo's terms.

Bullet multiplies the friction and the restitution of the two bodies. MuJoCo takes the larger friction and has no
restitution, but a damped spring at the contact; so each pair of geoms that may touch gets an explicit ``<pair>``, whose
damping ratio is looked up by restitution in a measured table. Bullet's friction is of the sliding kind only (Kubric
leaves spinning and rolling friction at 0), hence ``condim`` 3.
"""

from dataclasses import dataclass

import numpy as np

CALIBRATED_TIMESTEP = 1 / 960  # s; at coarser steps the spring would be sampled too rarely
# Natural frequency of the contact spring, rad/s: an impact lasts about ten steps, a body that lands at 9 m/s (from
# 4 m) sinks in by 2 cm for some milliseconds, and one that rests by g / frequency^2 = 0.1 mm.
CONTACT_FREQUENCY = 300.0
IMPEDANCE = (0.99, 0.99, 0.001)
# (damping ratio, restitution) as ``contact_calibration.measure_restitution`` finds them: the mean over impacts at 2, 4
# and 8 m/s that begin at different moments between two steps. A single impact scatters about it by up to 0.07
# (faster ones bounce a little more, for the spring also carries the weight).
RESTITUTION_TABLE: tuple[tuple[float, float], ...] = (
    (0.03, 0.9107),
    (0.05, 0.8568),
    (0.1, 0.7394),
    (0.15, 0.6413),
    (0.2, 0.5593),
    (0.25, 0.4901),
    (0.3, 0.4311),
    (0.4, 0.3369),
    (0.5, 0.2661),
    (0.6, 0.2118),
    (0.7, 0.1692),
    (0.8, 0.1345),
    (1.0, 0.0826),
    (1.2, 0.0465),
    (1.5, 0.0178),
)
LARGEST_RESTITUTION = 0.9


@dataclass(frozen=True)
class Surface:
    """What a body brings into a contact."""

    friction: float  # sliding, 0 and more
    restitution: float  # 0 to 1

    def against(self, other: "Surface") -> "Surface":
        """Return the contact of two bodies, by Bullet's rule: products."""
        return Surface(self.friction * other.friction, self.restitution * other.restitution)


def solver_reference(restitution: float) -> tuple[float, float]:
    """Return MuJoCo's ``solref`` (time constant in seconds, damping ratio) for a restitution.

    Interpolates the measured table; below its smallest value the most damped contact is taken, above its largest the
    least damped.
    """
    ratios, measured = np.asarray(RESTITUTION_TABLE).T
    ratio = float(np.interp(restitution, measured[::-1], ratios[::-1]))
    return contact_time_constant(ratio), ratio


def contact_time_constant(damping_ratio: float) -> float:
    """Return the time constant (s) that gives the contact spring its natural frequency at this damping."""
    return 1.0 / (CONTACT_FREQUENCY * damping_ratio)


def option_xml(timestep: float) -> str:
    """Return the ``<option>`` element of a scene with these contacts: Kubric's gravity, and its steps in seconds.

    The elliptic cone has the same friction in all directions.
    """
    return f'<option timestep="{timestep!r}" gravity="0 0 -10" integrator="implicitfast" cone="elliptic"/>'


def pair_xml(first: str, second: str, contact: Surface) -> str:
    """Return the ``<pair>`` element of two geoms."""
    time_constant, ratio = solver_reference(contact.restitution)
    return (
        f'<pair geom1="{first}" geom2="{second}" condim="3" friction="{contact.friction!r} {contact.friction!r}"'
        f' solref="{time_constant!r} {ratio!r}" solimp="{" ".join(map(repr, IMPEDANCE))}"/>'
    )

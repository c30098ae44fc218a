"""Rigid and soft bodies that keep moving until learned forces and contacts act."""

from vpd_lightning.dynamics.inertial.dynamics import InertialDynamics

__all__ = ["InertialDynamics"]

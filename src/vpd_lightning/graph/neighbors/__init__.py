"""Neighbour search: ``knn`` and ``radius``, with one module per backend and brute force as the definition."""

from vpd_lightning.graph.neighbors.contract import Neighbors
from vpd_lightning.graph.neighbors.search import BACKENDS, PointIndex, automatic_backend, knn, radius

__all__ = ["BACKENDS", "Neighbors", "PointIndex", "automatic_backend", "knn", "radius"]

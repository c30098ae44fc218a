"""Compares many evaluated runs: tables, curves, grids and videos (``vpd-report``)."""

"""Benchmarks: run time against error, against peers, against the plain way of doing the same. See README.md."""

"""Orchestrates trainings and evaluations as runs on disk: claim, resume, sweep, evaluate."""

"""Under which names checkpoints and released models keep what they were trained on."""

DATA_SHA256 = "data_sha256"
"""The digests of the data sets: more than one where a training went on with another."""

TRAINED_ON = "trained_on_sha256"
"""The SHA-256 of each trajectory that a training saw, that of a first training included; null: not known."""

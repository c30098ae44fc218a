"""How good is a trained simulator: the held-out protocol, its references, motion against ground truth, and reports."""

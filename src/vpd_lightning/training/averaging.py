"""How much an exponential moving average of weights keeps of itself."""


def share_kept(num_averaged: int, decay: float, warmup: float) -> float:
    """Return how much of the average of that many weights stays when the next ones are taken in.

    It is ``decay`` in the long run, and less before, so that a short training forgets its first weights, too.
    """
    return min(decay, (1 + num_averaged) / (warmup + num_averaged))

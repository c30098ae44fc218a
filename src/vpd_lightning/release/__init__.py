"""Models to give away: weights, configuration, card and an optional renderer program."""

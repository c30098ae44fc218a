"""Training on a rented GPU machine: little travels there, little comes back, and time there ends without warning.

``__main__.py`` has the commands, ``packing.py`` what travels there (recordings and settings), ``progress.py`` what
comes back and goes there again (weights, what Adam needs, the curve), ``training.py`` the loop.
"""

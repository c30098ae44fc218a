"""Planning with a trained simulator: what a tool should do so that particles go where they should."""

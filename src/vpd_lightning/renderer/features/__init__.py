"""Features of query points, summed over the particles around them."""

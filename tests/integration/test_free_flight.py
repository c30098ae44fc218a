"""VPD learns motion from pixels: balls in free flight, each with a velocity of its own."""

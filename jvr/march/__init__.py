"""How one ray becomes radiance, for a whole batch of rays at a time."""

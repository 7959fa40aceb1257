"""Adaptive sampling on slices: its own loop, the replay of that, and the oracles that say where samples may be far apart."""

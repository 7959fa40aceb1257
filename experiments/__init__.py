"""Experiments whose tables and figures are in `docs/`; each regenerates with one command."""

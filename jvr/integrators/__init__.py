"""Integrators beside the default: nothing that makes pictures, fits or files knows one of them but by its public name."""

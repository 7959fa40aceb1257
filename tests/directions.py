"""Unit directions about a surface that faces along z, and whether drawn ones have the density that is claimed."""

import math

import jax.numpy as jnp
import numpy as np
from scipy.stats import chisquare


def towards(polar, azimuth=0.0):
    """A unit direction, in degrees from the normal."""
    a, b = math.radians(polar), math.radians(azimuth)
    return np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])


def triple(v):
    """The components of directions along the first axis."""
    return tuple(jnp.asarray(c) for c in v)


def histogram(directions, low=-1.0, **weights):
    """Over 12 x 24 cells of the same solid angle, of cosines from `low` to 1."""
    x, y, z = directions
    return np.histogram2d(z, np.arctan2(y, x), bins=(12, 24), range=((low, 1), (-np.pi, np.pi)), **weights)[0].ravel()


def chance(directions, fits, expected, low=-1.0):
    """The chance of a chi-square test that directions have `expected` shares of each cell; what does not fit is in one cell more."""
    x, y, z = (np.asarray(c) for c in directions)
    observed = np.append(histogram((x[fits], y[fits], z[fits]), low), np.sum(~fits))
    wanted = len(z) * np.append(expected, 1 - expected.sum())
    enough = wanted > 10
    observed, wanted = (np.append(a[enough], a[~enough].sum()) for a in (observed, wanted))
    # Cells that nothing is expected in say whether something is.
    wanted = np.maximum(wanted, 1e-9)
    assert enough.sum() > 30
    return chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue

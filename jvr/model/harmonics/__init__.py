"""`jvr.sh`: real spherical harmonics, orthonormal, `Y_lm` at index `l (l + 1) + m`; coefficients lie along the first axis."""

from jvr.model.harmonics.algebra import coupling as coupling
from jvr.model.harmonics.algebra import product as product
from jvr.model.harmonics.algebra import product_to as product_to
from jvr.model.harmonics.algebra import rotate as rotate
from jvr.model.harmonics.algebra import triple_product as triple_product
from jvr.model.harmonics.algebra import two_double_products as two_double_products
from jvr.model.harmonics.basis import evaluate as evaluate
from jvr.model.harmonics.basis import order_of as order_of
from jvr.model.harmonics.projection import convolve as convolve
from jvr.model.harmonics.projection import fit_samples as fit_samples
from jvr.model.harmonics.projection import project as project
from jvr.model.harmonics.projection import project_map as project_map
from jvr.model.harmonics.projection import window as window
from jvr.model.harmonics.projection import zonal as zonal

"""What all renderers share besides the scene."""

# Of the machine that the figures are promised for.
THREADS = 2
# A ray ends once its transmittance is at most this: a quarter of an 8-bit step behind it.
TERMINATION = 1e-3
# Lengths of a segment that a renderer may choose from, in voxels.
STEPS = tuple(4 * 2 ** (-i / 4) for i in range(25))
# Of the float64 reference.
REFERENCE_STEP = 1 / 16
# The same where every sample sends a ray to the light.
LIT_REFERENCE_STEP = 1 / 2

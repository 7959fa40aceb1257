"""Figures of a fit: the transfer function with its uncertainty, the way there, and the pictures beside their targets.

Every function returns a `matplotlib` figure that belongs to no window and to no global state; `png` turns one into a file's bytes.
"""

from jvr.report.plots.convergence import plot_convergence as plot_convergence
from jvr.report.plots.look import png as png
from jvr.report.plots.pictures import comparison_strip as comparison_strip
from jvr.report.plots.transfer import plot_transfer as plot_transfer

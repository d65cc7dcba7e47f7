"""The face of the product: command line, launcher, data sets, replay and report."""

__version__ = "0.1.0"

"""Makes steel designs, and noisy synthetic scans of them with the truth beside them."""

__version__ = "0.1.0"

"""The Python interface: whole inputs, and functions on arrays."""

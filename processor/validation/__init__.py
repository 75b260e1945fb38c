"""Accuracy validated every night: a matrix of scenes made, run and held against their truth, and what changed since."""

"""Accuracy validated every night: a matrix of scenes made, run and compared with their truth, and its changes."""

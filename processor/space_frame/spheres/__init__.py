"""Spheres at nodes and in clouds without a design. Read ``alternating_fit``, ``size_selection``, ``ball_fit``."""

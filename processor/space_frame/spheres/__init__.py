"""Spheres at nodes, and in clouds without a design. Read ``fit_all``, then ``size_selection``, then ``final_fit``."""

"""Designs recognised from surfaces: bodies, faces, balls, tubes, sections and joints, and their unit."""

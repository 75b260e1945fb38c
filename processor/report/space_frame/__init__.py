"""Report of the step spheres."""

"""Targets in scans: checkerboards by their intensity, spheres by their shape; named by known coordinates."""

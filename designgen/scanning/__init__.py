"""Scans by rays: ``scan_settings``, ``survey``, ``returns``, ``raycast``, ``ray_kernels``, in order of reading.

``sampler`` is the scan without rays; ``surfaces`` are what rays meet.
"""

"""Registration of a scan to its design: principal axes, attitudes, iterative closest points, the fit of surfaces."""

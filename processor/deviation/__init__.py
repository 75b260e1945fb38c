"""Deviation of a scan from a design, or from another scan, with levels of detection."""

"""Pages of reports, read as text or in a browser."""

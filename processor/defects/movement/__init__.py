"""Components that moved as a whole."""

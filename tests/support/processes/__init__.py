"""Programs, batches and clusters that tests start."""

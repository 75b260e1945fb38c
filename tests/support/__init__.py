"""What several test files and benches use: made clouds, scenes, results and pages, and ways to read them."""

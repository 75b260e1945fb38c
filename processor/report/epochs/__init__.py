"""The report of a comparison of epochs: lines, tables, figure, page and JSON."""

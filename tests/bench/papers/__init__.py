"""The tables and figures of the source papers: the papers' methods on data sets of their sizes, beside ours."""

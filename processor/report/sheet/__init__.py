"""The sheet: what a reader signs, as a document of few pages and as the first screens of the page."""

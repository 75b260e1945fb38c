"""The adjustment of the whole chain, and what follows from it: poses, line, span and closure."""

"""Step ``inspect``: the characteristics of every part, each with its interval and its verdict."""
